//! Lines, discs and text, written as SVG and drawn as pixels: both show the same.
use std::fmt::Write;

use glam::Vec2;

use crate::pixels::{Canvas, Pixels};

/// The style sheet that drawings inside of a page need.
pub const STYLE: &str = include_str!("style.css");

/// What a colour is for: the page's style says which one it is, on light and on dark paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Color {
    /// Text and axes.
    Ink,
    /// Lines of the grid.
    Grid,
    /// What stands back.
    Soft,
    /// One of twelve that differ, repeated: eight that people with a colour vision deficiency tell
    /// apart [Okabe and Ito 2008], then darker ones.
    Series(usize),
}

/// Colours of series on light paper, as in `style.css`.
const SERIES: [[u8; 3]; 12] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [230, 159, 0],
    [86, 180, 233],
    [0, 0, 0],
    [148, 103, 50],
    [120, 94, 200],
    [100, 140, 40],
    [180, 40, 60],
    [90, 110, 120],
];

impl Color {
    /// sRGB on light paper, 8 bits each.
    pub(crate) fn on_light(self) -> [u8; 3] {
        match self {
            Self::Ink => [40, 40, 40],
            Self::Grid => [220, 223, 227],
            Self::Soft => [120, 120, 120],
            Self::Series(k) => SERIES[k % SERIES.len()],
        }
    }

    /// As CSS has it.
    fn css(self) -> String {
        match self {
            Self::Ink => "var(--ink)".into(),
            Self::Grid => "var(--grid)".into(),
            Self::Soft => "var(--soft)".into(),
            Self::Series(k) => format!("var(--s{})", k % SERIES.len()),
        }
    }
}

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
pub(crate) enum Shape {
    Line {
        points: Vec<Vec2>,
        width: f32,
        opacity: f32,
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

/// A picture of lines and text.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawing {
    width: usize,
    height: usize,
    shapes: Vec<Shape>,
}

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
            opacity: 1.0,
            color,
        });
    }

    /// Adds a thin, pale line through `points`.
    pub fn faint_line(&mut self, points: impl IntoIterator<Item = Vec2>, color: Color) {
        self.shapes.push(Shape::Line {
            points: points.into_iter().collect(),
            width: 1.0,
            opacity: 0.3,
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
        if text.is_empty() {
            return;
        }
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
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"chart\" viewBox=\"0 0 {w} {h}\" \
             width=\"{w}\" height=\"{h}\">\n<style>{STYLE}</style>\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"var(--paper)\"/>\n"
        );
        self.shapes.iter().for_each(|shape| svg += &svg_of(shape));
        svg + "</svg>\n"
    }

    /// An element of a page that has [`STYLE`], as wide as there is room, on the page's own paper.
    /// `label` says what it shows to those who cannot see it.
    pub fn to_inline_svg(&self, label: &str) -> String {
        let (w, h) = (self.width, self.height);
        let label = escaped(label);
        let mut svg = format!(
            "<svg class=\"chart\" viewBox=\"0 0 {w} {h}\" role=\"img\" aria-label=\"{label}\">\n"
        );
        self.shapes.iter().for_each(|shape| svg += &svg_of(shape));
        svg + "</svg>\n"
    }

    /// Draws onto white pixels; a unit of the drawing is `scale` pixels.
    pub fn to_pixels(&self, scale: usize) -> Pixels {
        let mut canvas = Canvas::new(self.width * scale, self.height * scale, scale as f32);
        self.shapes.iter().for_each(|shape| canvas.draw(shape));
        canvas.pixels
    }
}

/// Text inside of an element or an attribute.
fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            // Not allowed in XML, whatever the escape.
            c if c.is_control() => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

fn svg_of(shape: &Shape) -> String {
    match shape {
        Shape::Line {
            points,
            width,
            opacity,
            color,
        } => {
            let mut places = String::new();
            for p in points {
                let _ = write!(places, "{:.1},{:.1} ", p.x, p.y);
            }
            let faint = match *opacity < 1.0 {
                true => format!(" opacity=\"{opacity}\""),
                false => String::new(),
            };
            format!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width}\" \
                 stroke-linejoin=\"round\"{faint}/>\n",
                places.trim_end(),
                color.css()
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
            color.css()
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
            color.css()
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
                color.css(),
                escaped(text)
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INK: Color = Color::Ink;

    #[test]
    fn a_line_covers_its_pixels_and_no_others() {
        let mut drawing = Drawing::new(10, 10);
        drawing.line([Vec2::new(2.0, 5.0), Vec2::new(8.0, 5.0)], 2.0, INK);
        let image = drawing.to_pixels(1);
        let ink = INK.on_light();
        assert_eq!([image.get(5, 4), image.get(5, 5)], [ink; 2]);
        assert_eq!([image.get(5, 7), image.get(0, 5)], [[255; 3]; 2]);
        assert_eq!(drawing.to_pixels(2).width, 20);
    }

    #[test]
    fn text_and_svg_show_what_was_drawn() {
        let mut drawing = Drawing::new(60, 30);
        drawing.text(Vec2::new(30.0, 20.0), 12.0, Anchor::Middle, "a<b", INK);
        drawing.disc(Vec2::new(5.0, 5.0), 3.0, Color::Series(1));
        drawing.ring(Vec2::new(50.0, 8.0), 4.0, 1.0, Color::Series(2));
        let svg = drawing.to_svg();
        assert!(
            svg.contains(">a&lt;b</text>") && svg.contains("fill=\"var(--s1)\""),
            "{svg}"
        );
        let image = drawing.to_pixels(1);
        assert_eq!(image.get(5, 5), [213, 94, 0]);
        let text = (20..40).flat_map(|x| (8..22).map(move |y| (x, y)));
        assert!(text.filter(|&(x, y)| image.get(x, y)[0] < 128).count() > 5);
    }

    #[test]
    fn text_that_runs_upwards_stays_left_of_its_place() {
        let mut drawing = Drawing::new(40, 60);
        drawing.text_upwards(Vec2::new(20.0, 50.0), 12.0, Anchor::Start, "HH", INK);
        let image = drawing.to_pixels(1);
        let dark = |x: usize| (0..60).any(|y| image.get(x, y)[0] < 128);
        assert!((12..20).any(dark) && !(23..40).any(dark));
    }

    #[test]
    fn every_colour_has_a_place_in_the_style_for_light_and_for_dark_paper() {
        let names = (0..SERIES.len()).map(|k| format!("--s{k}: "));
        for name in names.chain(["--paper: ", "--ink: ", "--grid: ", "--soft: "].map(String::from))
        {
            assert_eq!(STYLE.matches(&name).count(), 2, "{name}");
        }
        for (k, [r, g, b]) in SERIES.into_iter().enumerate() {
            let rule = format!("--s{k}: #{r:02x}{g:02x}{b:02x}");
            assert!(STYLE.contains(&rule), "{rule}");
        }
    }

    #[test]
    fn an_inline_drawing_says_what_it_shows_and_is_text_whatever_it_is_called() {
        let svg = Drawing::new(10, 10).to_inline_svg("a \"loss\" <b>");
        assert!(
            svg.contains("aria-label=\"a &quot;loss&quot; &lt;b&gt;\""),
            "{svg}"
        );
    }
}
