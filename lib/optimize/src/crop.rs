//! The part of the picture that the guidance sees.
use dipir_imaging::raster::Raster;
use dipir_imaging::resize::{CropResize, Filter, PixelBox};
use dipir_numerics::sampler::{Sampler, Stream};
use glam::Vec3;

/// Which part of the picture a guidance needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Framing {
    /// Every pixel, as it is.
    Whole,
    /// A random square around the object in every iteration, resized.
    Crops {
        /// Side in pixels after resizing.
        side: usize,
        /// Smallest and largest side of the square, as multiples of the longer side of the object's
        /// box.
        scale: [f32; 2],
    },
}

/// The part of the picture that one iteration sees.
#[derive(Clone, Debug)]
pub struct CropView {
    /// The box in the picture; `None` for all of it.
    pub crop: Option<PixelBox>,
    resize: Option<CropResize>,
}

impl CropView {
    /// All of the picture.
    pub fn whole() -> Self {
        Self {
            crop: None,
            resize: None,
        }
    }

    /// `crop` of a picture of `size`, bilinearly resized to `side` x `side` pixels.
    pub fn of(size: (usize, usize), crop: PixelBox, side: usize) -> Self {
        Self {
            crop: Some(crop),
            resize: Some(CropResize::new(size, crop, (side, side), Filter::Tent)),
        }
    }

    /// The part of `picture`.
    pub fn apply(&self, picture: &Raster<Vec3>) -> Raster<Vec3> {
        match &self.resize {
            Some(resize) => resize.apply(picture),
            None => picture.clone(),
        }
    }

    /// Adjoint of [`apply`](Self::apply): the gradient of every pixel of the picture.
    pub fn apply_vjp(&self, gradient: Raster<Vec3>) -> Raster<Vec3> {
        match &self.resize {
            Some(resize) => resize.apply_vjp(&gradient),
            None => gradient,
        }
    }
}

/// The usual [`Framing::Crops::scale`]: from details of the object to its surroundings, its shadow
/// among them.
pub const USUAL_SCALE: [f32; 2] = [0.75, 3.0];

/// Draws crops around the object.
#[derive(Clone, Copy, Debug)]
pub struct CropSampler {
    size: (usize, usize),
    object: PixelBox,
}

impl CropSampler {
    /// For an object of this coverage; the whole picture counts as its box where it covers none.
    pub fn new(coverage: &Raster<f32>) -> Self {
        let size = (coverage.width(), coverage.height());
        Self {
            size,
            object: bounding_box(coverage).unwrap_or(PixelBox {
                x: 0,
                y: 0,
                width: size.0,
                height: size.1,
            }),
        }
    }

    /// The square of one iteration, a function of `seed` and `iteration` alone. Its side is drawn
    /// log-uniformly from `scale` times the longer side of the object's box, and is at most the
    /// picture's shorter side. Its middle lies in the object's box, unless the square would leave
    /// the picture.
    pub fn crop(&self, seed: u64, iteration: usize, scale: [f32; 2]) -> PixelBox {
        let mut sampler = Sampler::new(seed, Stream::OPTIMIZE, 0, iteration as u32);
        let [smallest, largest] = scale;
        let scale = smallest * (largest / smallest).powf(sampler.next_1d());
        let middle = sampler.next_2d();
        let object = &self.object;
        let longer = object.width.max(object.height) as f32;
        let shorter = self.size.0.min(self.size.1);
        let side = ((longer * scale).round() as usize).clamp(1, shorter);
        let start = |from: usize, length: usize, u: f32, limit: usize| {
            let middle = from as f32 + u * length as f32;
            let first = (middle - 0.5 * side as f32).round().max(0.0) as usize;
            first.min(limit - side)
        };
        PixelBox {
            x: start(object.x, object.width, middle.x, self.size.0),
            y: start(object.y, object.height, middle.y, self.size.1),
            width: side,
            height: side,
        }
    }
}

/// The smallest box around all covered pixels; `None` if there are none.
pub fn bounding_box(coverage: &Raster<f32>) -> Option<PixelBox> {
    let mut range: Option<[usize; 4]> = None;
    for y in 0..coverage.height() {
        for (x, &a) in coverage.row(y).iter().enumerate() {
            if a > 0.0 {
                let [left, top, right, bottom] = range.unwrap_or([x, y, x, y]);
                range = Some([left.min(x), top.min(y), right.max(x), bottom.max(y)]);
            }
        }
    }
    range.map(|[left, top, right, bottom]| PixelBox {
        x: left,
        y: top,
        width: right + 1 - left,
        height: bottom + 1 - top,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coverage(width: usize, height: usize, object: PixelBox) -> Raster<f32> {
        let mut raster = Raster::filled(width, height, 0.0);
        for y in object.y..object.y + object.height {
            for x in object.x..object.x + object.width {
                *raster.get_mut(x, y) = 0.5;
            }
        }
        raster
    }

    fn boxed(x: usize, y: usize, width: usize, height: usize) -> PixelBox {
        PixelBox {
            x,
            y,
            width,
            height,
        }
    }

    #[test]
    fn crops_stay_in_the_picture_touch_the_object_and_come_in_many_sizes() {
        for (size, object) in [
            ((96, 64), boxed(40, 20, 16, 12)),
            ((64, 96), boxed(0, 80, 10, 16)),
            ((31, 7), boxed(30, 0, 1, 1)),
            ((1, 1), boxed(0, 0, 1, 1)),
        ] {
            let sampler = CropSampler::new(&coverage(size.0, size.1, object));
            let crops: Vec<_> = (0..256).map(|k| sampler.crop(7, k, USUAL_SCALE)).collect();
            for c in &crops {
                assert!(c.x + c.width <= size.0 && c.y + c.height <= size.1, "{c:?}");
                assert_eq!(c.width, c.height);
                let apart = c.x >= object.x + object.width || object.x >= c.x + c.width;
                assert!(!apart, "{c:?} shows nothing of {object:?}");
            }
            let again = sampler.crop(7, 100, USUAL_SCALE);
            assert_eq!(again, crops[100]);
        }
        let sampler = CropSampler::new(&coverage(96, 64, boxed(40, 20, 16, 12)));
        let sides: Vec<_> = (0..256)
            .map(|k| sampler.crop(0, k, USUAL_SCALE).width)
            .collect();
        // 16 pixels times .75 to 3.
        assert_eq!(sides.iter().min(), Some(&12));
        assert!(sides.iter().all(|s| *s <= 48) && sides.contains(&47));
    }

    #[test]
    fn an_object_out_of_sight_leaves_the_whole_picture() {
        let sampler = CropSampler::new(&Raster::filled(10, 6, 0.0));
        assert!((0..32).all(|k| sampler.crop(0, k, USUAL_SCALE).width <= 6));
    }
}
