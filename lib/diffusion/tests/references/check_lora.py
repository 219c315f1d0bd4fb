"""Loads LoRA files that this project wrote into diffusers, and the reverse.

    cd lib/diffusion && cargo run --example export_lora -- tests/references/sd21 OUT
    python tests/references/check_lora.py sd21 OUT

OUT holds lora.safetensors (PEFT keys), lora_kohya.safetensors and
prediction.safetensors (sample, context, timestep and the prediction with the
adapter). Both files go through load_lora_weights; the predictions must agree
to 1e-4. The reverse, files written by diffusers and peft and read here, is
the test tests/parity.rs.
"""

import pathlib
import sys

import torch
from diffusers import DDIMScheduler, StableDiffusionPipeline, AutoencoderKL, UNet2DConditionModel
from safetensors.torch import load_file
from transformers import CLIPTextModel, CLIPTokenizer


def main():
    family, out = sys.argv[1], pathlib.Path(sys.argv[2])
    folder = pathlib.Path(__file__).parent / family
    reference = load_file(out / "prediction.safetensors")
    worst = 0.0
    for name in ["lora.safetensors", "lora_kohya.safetensors"]:
        unet = UNet2DConditionModel.from_pretrained(folder / "unet", torch_dtype=torch.float32)
        pipeline = StableDiffusionPipeline(
            vae=AutoencoderKL.from_pretrained(folder / "vae", torch_dtype=torch.float32),
            text_encoder=CLIPTextModel.from_pretrained(folder / "text_encoder", torch_dtype=torch.float32),
            tokenizer=CLIPTokenizer.from_pretrained(folder / "tokenizer"),
            unet=unet,
            scheduler=DDIMScheduler.from_config(folder / "scheduler"),
            safety_checker=None,
            feature_extractor=None,
            requires_safety_checker=False,
        )
        predict = lambda: unet(reference["sample"], int(reference["timestep"]), reference["context"]).sample
        with torch.no_grad():
            base = predict()
            pipeline.load_lora_weights(out, weight_name=name)
            found = predict()
        wanted = reference["prediction"]
        error = ((found - wanted).abs().max() / wanted.abs().max()).item()
        moved = ((base - wanted).abs().max() / wanted.abs().max()).item()
        print(f"{family} {name}: relative error {error:.1e}; the adapter moves the prediction by {moved:.1e}")
        assert moved > 1e-2, "the adapter does nothing"
        worst = max(worst, error)
    assert worst < 1e-4, worst


if __name__ == "__main__":
    main()
