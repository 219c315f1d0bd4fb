//! Hairlines with a dark halo, drawn over a picture.
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_plotting::distance_to_segment;
use dipir_plotting::glyphs::{CAPITAL, lay_out};
use glam::{Vec2, Vec3};

/// How lines of one kind look.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pen {
    /// sRGB in [0, 1].
    pub color: Vec3,
    /// Pixels.
    pub width: f32,
    /// From 0 to 1.
    pub opacity: f32,
}

/// Opacity of the halo beside a line's own.
const HALO: f32 = 0.5;
/// How far the halo reaches beyond the line, pixels.
const HALO_PX: f32 = 1.1;

/// Lines that are drawn in one colour: where they overlap, none shows twice.
pub struct Layer {
    width: usize,
    height: usize,
    /// Coverage of line and halo.
    coverage: Vec<Vec2>,
}

impl Layer {
    /// Nothing, on `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            coverage: vec![Vec2::ZERO; width * height],
        }
    }

    /// Adds a segment, pixels from the top left corner.
    pub fn line(&mut self, a: Vec2, b: Vec2, width: f32, opacity: f32) {
        let reach = 0.5 * width + HALO_PX + 1.0;
        let (low, high) = (a.min(b) - reach, a.max(b) + reach);
        let range = |low: f32, high: f32, size: usize| {
            let first = (low.floor().max(0.0) as usize).min(size);
            first..((high.ceil().max(0.0)) as usize).min(size)
        };
        for y in range(low.y, high.y, self.height) {
            for x in range(low.x, high.x, self.width) {
                let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let d = distance_to_segment(p, a, b);
                let edge = |half: f32| opacity * (half + 0.5 - d).clamp(0.0, 1.0);
                let found = Vec2::new(edge(0.5 * width), edge(0.5 * width + HALO_PX));
                let at = &mut self.coverage[y * self.width + x];
                *at = at.max(found);
            }
        }
    }

    /// Adds text whose letters stand in the middle above `at`; capitals are `capital` pixels high.
    pub fn text(&mut self, at: Vec2, capital: f32, text: &str) {
        let (strokes, width) = lay_out(text);
        let unit = capital / CAPITAL;
        for stroke in strokes {
            let place = |&(x, y): &(f32, f32)| at + Vec2::new(x - 0.5 * width, -y) * unit;
            let points: Vec<Vec2> = stroke.iter().map(place).collect();
            for pair in points.windows(2) {
                self.line(pair[0], pair[1], 0.13 * capital, 1.0);
            }
        }
    }

    /// Draws the layer over `picture`, but not where `hidden` is 1.
    pub fn blend(&self, picture: &mut DisplayImage, pen: &Pen, hidden: Option<&Raster<f32>>) {
        let pixels = picture.0.pixels_mut().iter_mut();
        for (k, (pixel, found)) in pixels.zip(&self.coverage).enumerate() {
            if found.y > 0.0 {
                let seen = 1.0 - hidden.map_or(0.0, |h| h.pixels()[k]);
                let opacity = pen.opacity * seen;
                *pixel = pixel.lerp(Vec3::ZERO, HALO * opacity * found.y);
                *pixel = pixel.lerp(pen.color, opacity * found.x);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_bright_on_its_pixels_and_dark_beside_them() {
        let mut picture = DisplayImage(Raster::filled(9, 9, Vec3::splat(0.5)));
        let mut layer = Layer::new(9, 9);
        layer.line(Vec2::new(4.5, -3.0), Vec2::new(4.5, 20.0), 1.0, 1.0);
        let pen = Pen {
            color: Vec3::ONE,
            width: 1.0,
            opacity: 1.0,
        };
        layer.blend(&mut picture, &pen, None);
        let row: Vec<f32> = picture.0.row(4).iter().map(|p| p.x).collect();
        // Opacities are multiplied in single precision.
        assert!((row[4] - 1.0).abs() < 1e-6, "{row:?}");
        assert!(row[3] < 0.3 && row[5] < 0.3, "{row:?}");
        assert_eq!((row[1], row[7]), (0.5, 0.5));
    }

    #[test]
    fn two_pieces_of_a_line_show_no_joint() {
        let ends = [
            Vec2::new(1.0, 4.5),
            Vec2::new(6.0, 4.5),
            Vec2::new(11.0, 4.5),
        ];
        let (mut whole, mut pieces) = (Layer::new(12, 9), Layer::new(12, 9));
        whole.line(ends[0], ends[2], 1.0, 0.5);
        pieces.line(ends[0], ends[1], 1.0, 0.5);
        pieces.line(ends[1], ends[2], 1.0, 0.5);
        assert_eq!(whole.coverage, pieces.coverage);
    }
}
