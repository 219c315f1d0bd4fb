//! Drawings as pixels, antialiased.
use glam::{Vec2, Vec3};

use crate::drawing::{Anchor, Color, Shape};
use crate::glyphs::{CAPITAL, lay_out};

/// Width of a letter's strokes as a share of a capital's height.
const STROKE: f32 = 0.11;
/// A capital's height as a share of a font's size, in the usual sans-serif fonts.
const CAPITAL_OF_SIZE: f32 = 0.72;

/// A picture on white.
#[derive(Clone, Debug, PartialEq)]
pub struct Pixels {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// sRGB in [0, 1], row by row.
    pub colors: Vec<Vec3>,
}

impl Pixels {
    /// The colour of a pixel, 8 bits each.
    pub fn get(&self, x: usize, y: usize) -> [u8; 3] {
        let color = self.colors[y * self.width + x].to_array();
        color.map(|v| (v * 255.0 + 0.5) as u8)
    }
}

/// Pixels that are drawn on.
pub(crate) struct Canvas {
    pub(crate) pixels: Pixels,
    scale: f32,
}

impl Canvas {
    /// White, `scale` pixels for each of the drawing's.
    pub(crate) fn new(width: usize, height: usize, scale: f32) -> Self {
        let colors = vec![Vec3::ONE; width * height];
        let pixels = Pixels {
            width,
            height,
            colors,
        };
        Self { pixels, scale }
    }

    pub(crate) fn draw(&mut self, shape: &Shape) {
        match shape {
            Shape::Line {
                points,
                width,
                opacity,
                color,
            } => self.polyline(points, *width, *color, *opacity),
            Shape::Disc {
                center,
                radius,
                color,
            } => self.polyline(&[*center], 2.0 * radius, *color, 1.0),
            Shape::Ring {
                center,
                radius,
                width,
                color,
            } => {
                let c = *center * self.scale;
                let (r, half) = (radius * self.scale, 0.5 * width * self.scale);
                self.fill(c - r - half, c + r + half, *color, 1.0, |p| {
                    (p.distance(c) - r).abs() - half
                });
            }
            Shape::Text {
                at,
                size,
                anchor,
                upwards,
                text,
                color,
            } => {
                let (strokes, width) = lay_out(text);
                let unit = size * CAPITAL_OF_SIZE / CAPITAL;
                let start = match anchor {
                    Anchor::Start => 0.0,
                    Anchor::Middle => -0.5 * width,
                    Anchor::End => -width,
                };
                for stroke in strokes {
                    let place = |(x, y): (f32, f32)| {
                        let offset = Vec2::new(start + x, -y) * unit;
                        *at + match upwards {
                            true => Vec2::new(offset.y, -offset.x),
                            false => offset,
                        }
                    };
                    let points: Vec<Vec2> = stroke.into_iter().map(place).collect();
                    self.polyline(&points, STROKE * CAPITAL * unit, *color, 1.0);
                }
            }
        }
    }

    /// A line with round joints and ends; one point is a disc.
    fn polyline(&mut self, points: &[Vec2], width: f32, color: Color, opacity: f32) {
        let half = 0.5 * width * self.scale;
        let scaled: Vec<Vec2> = points.iter().map(|p| *p * self.scale).collect();
        let Some(first) = scaled.first() else { return };
        let low = scaled.iter().fold(*first, |a, p| a.min(*p)) - half;
        let high = scaled.iter().fold(*first, |a, p| a.max(*p)) + half;
        self.fill(low, high, color, opacity, |p| {
            let pieces = scaled
                .windows(2)
                .map(|s| distance_to_segment(p, s[0], s[1]));
            pieces.fold(p.distance(*first), f32::min) - half
        });
    }

    /// Blends `color` in where the signed distance is negative, antialiased over a pixel.
    fn fill(
        &mut self,
        low: Vec2,
        high: Vec2,
        color: Color,
        opacity: f32,
        distance: impl Fn(Vec2) -> f32,
    ) {
        let color = Vec3::from_array(color.on_light().map(|c| f32::from(c) / 255.0));
        let (width, height) = (self.pixels.width, self.pixels.height);
        let first = |v: f32| (v - 1.0).max(0.0) as usize;
        let last = |v: f32, n: usize| ((v + 2.0).max(0.0) as usize).min(n);
        for y in first(low.y)..last(high.y, height) {
            for x in first(low.x)..last(high.x, width) {
                let center = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let coverage = opacity * (0.5 - distance(center)).clamp(0.0, 1.0);
                if coverage > 0.0 {
                    let pixel = &mut self.pixels.colors[y * width + x];
                    *pixel = pixel.lerp(color, coverage);
                }
            }
        }
    }
}

/// From `p` to the nearest point between `a` and `b`.
pub fn distance_to_segment(p: Vec2, a: Vec2, b: Vec2) -> f32 {
    let along = b - a;
    let length = along.length_squared();
    let t = match length > 0.0 {
        true => ((p - a).dot(along) / length).clamp(0.0, 1.0),
        false => 0.0,
    };
    p.distance(a + t * along)
}
