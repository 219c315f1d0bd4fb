"""The numbers of metrics.rs: scikit-image's SSIM and RMSE, and scale-invariant RMSE by least squares.

    pip install scikit-image pillow numpy && python lib/imaging/tests/metrics.py
"""
import pathlib

import numpy as np
import skimage
from PIL import Image
from skimage.metrics import mean_squared_error, structural_similarity

folder = pathlib.Path(__file__).parent / "pictures"
a, b = (np.asarray(Image.open(folder / f"{name}.png"), dtype=np.float64) / 255.0 for name in ("changed", "reference"))
print("scikit-image", skimage.__version__)
ssim = structural_similarity(
    a, b, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, channel_axis=2
)
print("ssim    ", repr(float(ssim)))
print("rmse    ", repr(float(np.sqrt(mean_squared_error(a, b)))))
print("mae     ", repr(float(np.abs(a - b).mean())))
# min over s of |s a - b|, as a least-squares problem of one unknown.
for name, (image, reference) in {"si_rmse": (a, b), "si_rmse, swapped": (b, a)}.items():
    column = image.reshape(-1, 1)
    (scale,), *_ = np.linalg.lstsq(column, reference.ravel(), rcond=None)
    print(name, repr(float(np.sqrt(np.mean((scale * image - reference) ** 2)))))
