//! Lines, discs and text, written as SVG and drawn as pixels: both show the same.
use std::fmt::Write;

use dipir_imaging::raster::{DisplayImage, Raster};
use glam::{Vec2, Vec3};

use crate::glyphs::{CAPITAL, lay_out};

/// An sRGB colour, 8 bits each.
pub type Color = [u8; 3];

/// Where a text lies beside its place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// The place is its left end.
    Start,
    /// Its middle.
    Middle,
    /// Its right end.
    End,
}

/// A part of a drawing; lengths in pixels, y downwards.
#[derive(Clone, Debug, PartialEq)]
enum Shape {
    Line {
        points: Vec<Vec2>,
        width: f32,
        color: Color,
    },
    Disc {
        center: Vec2,
        radius: f32,
        color: Color,
    },
    Ring {
        center: Vec2,
        radius: f32,
        width: f32,
        color: Color,
    },
    Text {
        at: Vec2,
        size: f32,
        anchor: Anchor,
        upwards: bool,
        text: String,
        color: Color,
    },
}

/// A picture of lines and text on white.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawing {
    width: usize,
    height: usize,
    shapes: Vec<Shape>,
}

/// Width of a letter's strokes as a share of a capital's height.
const STROKE: f32 = 0.11;
/// A capital's height as a share of a font's size, in the usual sans-serif fonts.
const CAPITAL_OF_SIZE: f32 = 0.72;

impl Drawing {
    /// Nothing, on `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            shapes: Vec::new(),
        }
    }

    /// Adds a line through `points`.
    pub fn line(&mut self, points: impl IntoIterator<Item = Vec2>, width: f32, color: Color) {
        self.shapes.push(Shape::Line {
            points: points.into_iter().collect(),
            width,
            color,
        });
    }

    /// Adds a filled disc.
    pub fn disc(&mut self, center: Vec2, radius: f32, color: Color) {
        self.shapes.push(Shape::Disc {
            center,
            radius,
            color,
        });
    }

    /// Adds a circle.
    pub fn ring(&mut self, center: Vec2, radius: f32, width: f32, color: Color) {
        self.shapes.push(Shape::Ring {
            center,
            radius,
            width,
            color,
        });
    }

    /// Adds text that stands on `at`.
    pub fn text(&mut self, at: Vec2, size: f32, anchor: Anchor, text: &str, color: Color) {
        self.push_text(at, size, anchor, text, color, false);
    }

    /// Adds text that runs upwards.
    pub fn text_upwards(&mut self, at: Vec2, size: f32, anchor: Anchor, text: &str, color: Color) {
        self.push_text(at, size, anchor, text, color, true);
    }

    fn push_text(
        &mut self,
        at: Vec2,
        size: f32,
        anchor: Anchor,
        text: &str,
        color: Color,
        upwards: bool,
    ) {
        self.shapes.push(Shape::Text {
            at,
            size,
            anchor,
            upwards,
            text: text.into(),
            color,
        });
    }

    /// An SVG file.
    pub fn to_svg(&self) -> String {
        let (w, h) = (self.width, self.height);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" \
             height=\"{h}\" font-family=\"Helvetica, Arial, sans-serif\">\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n"
        );
        for shape in &self.shapes {
            svg += &svg_of(shape);
        }
        svg + "</svg>\n"
    }

    /// As pixels, `scale` of them for each of the drawing's.
    pub fn to_image(&self, scale: usize) -> DisplayImage {
        let (width, height) = (self.width * scale, self.height * scale);
        let mut canvas = Canvas {
            image: Raster::filled(width, height, Vec3::ONE),
            scale: scale as f32,
        };
        for shape in &self.shapes {
            canvas.draw(shape);
        }
        DisplayImage(canvas.image)
    }
}

fn hex([r, g, b]: Color) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

fn svg_of(shape: &Shape) -> String {
    match shape {
        Shape::Line {
            points,
            width,
            color,
        } => {
            let mut places = String::new();
            for p in points {
                let _ = write!(places, "{:.1},{:.1} ", p.x, p.y);
            }
            format!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width}\" \
                 stroke-linejoin=\"round\"/>\n",
                places.trim_end(),
                hex(*color)
            )
        }
        Shape::Disc {
            center,
            radius,
            color,
        } => format!(
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{radius}\" fill=\"{}\"/>\n",
            center.x,
            center.y,
            hex(*color)
        ),
        Shape::Ring {
            center,
            radius,
            width,
            color,
        } => format!(
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{radius}\" fill=\"none\" stroke=\"{}\" \
             stroke-width=\"{width}\"/>\n",
            center.x,
            center.y,
            hex(*color)
        ),
        Shape::Text {
            at,
            size,
            anchor,
            upwards,
            text,
            color,
        } => {
            let anchor = match anchor {
                Anchor::Start => "start",
                Anchor::Middle => "middle",
                Anchor::End => "end",
            };
            let turn = match upwards {
                true => format!(" transform=\"rotate(-90 {:.1} {:.1})\"", at.x, at.y),
                false => String::new(),
            };
            format!(
                "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size}\" text-anchor=\"{anchor}\" \
                 fill=\"{}\"{turn}>{}</text>\n",
                at.x,
                at.y,
                hex(*color),
                escaped(text)
            )
        }
    }
}

struct Canvas {
    image: Raster<Vec3>,
    scale: f32,
}

impl Canvas {
    fn draw(&mut self, shape: &Shape) {
        match shape {
            Shape::Line {
                points,
                width,
                color,
            } => self.polyline(points, *width, *color),
            Shape::Disc {
                center,
                radius,
                color,
            } => self.polyline(&[*center], 2.0 * radius, *color),
            Shape::Ring {
                center,
                radius,
                width,
                color,
            } => {
                let c = *center * self.scale;
                let (r, half) = (radius * self.scale, 0.5 * width * self.scale);
                self.fill(c - r - half, c + r + half, *color, |p| {
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
                    self.polyline(&points, STROKE * CAPITAL * unit, *color);
                }
            }
        }
    }

    /// A line with round joints and ends; one point is a disc.
    fn polyline(&mut self, points: &[Vec2], width: f32, color: Color) {
        let half = 0.5 * width * self.scale;
        let scaled: Vec<Vec2> = points.iter().map(|p| *p * self.scale).collect();
        let Some(first) = scaled.first() else { return };
        let low = scaled.iter().fold(*first, |a, p| a.min(*p)) - half;
        let high = scaled.iter().fold(*first, |a, p| a.max(*p)) + half;
        self.fill(low, high, color, |p| {
            let pieces = scaled
                .windows(2)
                .map(|s| distance_to_segment(p, s[0], s[1]));
            pieces.fold(p.distance(*first), f32::min) - half
        });
    }

    /// Blends `color` in where the signed distance is negative, antialiased over a pixel.
    fn fill(&mut self, low: Vec2, high: Vec2, color: Color, distance: impl Fn(Vec2) -> f32) {
        let color = Vec3::from_array(color.map(|c| f32::from(c) / 255.0));
        let (width, height) = (self.image.width(), self.image.height());
        let first = |v: f32| (v - 1.0).max(0.0) as usize;
        let last = |v: f32, n: usize| ((v + 2.0).max(0.0) as usize).min(n);
        for y in first(low.y)..last(high.y, height) {
            for x in first(low.x)..last(high.x, width) {
                let center = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let coverage = (0.5 - distance(center)).clamp(0.0, 1.0);
                if coverage > 0.0 {
                    let pixel = self.image.get_mut(x, y);
                    *pixel = pixel.lerp(color, coverage);
                }
            }
        }
    }
}

fn distance_to_segment(p: Vec2, a: Vec2, b: Vec2) -> f32 {
    let along = b - a;
    let length = along.length_squared();
    let t = match length > 0.0 {
        true => ((p - a).dot(along) / length).clamp(0.0, 1.0),
        false => 0.0,
    };
    p.distance(a + t * along)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLACK: Color = [0, 0, 0];

    #[test]
    fn a_line_covers_its_pixels_and_no_others() {
        let mut drawing = Drawing::new(10, 10);
        drawing.line([Vec2::new(2.0, 5.0), Vec2::new(8.0, 5.0)], 2.0, BLACK);
        let image = drawing.to_image(1);
        assert_eq!(*image.0.get(5, 4), Vec3::ZERO);
        assert_eq!(*image.0.get(5, 5), Vec3::ZERO);
        assert_eq!(*image.0.get(5, 7), Vec3::ONE);
        assert_eq!(*image.0.get(0, 5), Vec3::ONE);
        assert_eq!(drawing.to_image(2).0.width(), 20);
    }

    #[test]
    fn text_and_svg_show_what_was_drawn() {
        let mut drawing = Drawing::new(60, 30);
        drawing.text(Vec2::new(30.0, 20.0), 12.0, Anchor::Middle, "a<b", BLACK);
        drawing.disc(Vec2::new(5.0, 5.0), 3.0, [255, 0, 0]);
        drawing.ring(Vec2::new(50.0, 8.0), 4.0, 1.0, [0, 0, 255]);
        let svg = drawing.to_svg();
        assert!(
            svg.contains(">a&lt;b</text>") && svg.contains("#ff0000"),
            "{svg}"
        );
        let image = drawing.to_image(1);
        assert_eq!(*image.0.get(5, 5), Vec3::new(1.0, 0.0, 0.0));
        let dark = (20..40).flat_map(|x| (8..22).map(move |y| (x, y)));
        assert!(dark.filter(|&(x, y)| image.0.get(x, y).x < 0.5).count() > 5);
    }

    #[test]
    fn text_that_runs_upwards_stays_left_of_its_place() {
        let mut drawing = Drawing::new(40, 60);
        drawing.text_upwards(Vec2::new(20.0, 50.0), 12.0, Anchor::Start, "HH", BLACK);
        let image = drawing.to_image(1);
        let dark = |x: usize| (0..60).any(|y| image.0.get(x, y).x < 0.5);
        assert!((12..20).any(dark) && !(23..40).any(dark));
    }
}
