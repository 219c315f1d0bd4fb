//! Lines and dots over a pair of axes, in panels side by side.
use glam::Vec2;

use crate::axis::Axis;
pub use crate::axis::Scale;
use crate::drawing::{Anchor, Color, Drawing};

/// How a series is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mark {
    /// A line.
    #[default]
    Line,
    /// A thin, pale line: raw values of a noisy quantity.
    Faint,
    /// A dot a point.
    Dots,
}

/// A point of a series.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Point {
    /// Along the horizontal axis.
    pub x: f64,
    /// Along the vertical axis.
    pub y: f64,
    /// Lower and upper end of the interval of `y`.
    pub interval: Option<(f64, f64)>,
    /// Written beside it; empty for nothing.
    pub label: String,
}

/// Points of one colour.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// For the legend; empty for none.
    pub name: String,
    /// Number of its colour. By default, series of the same name have the same colour in every
    /// panel.
    pub color: Option<usize>,
    /// How it is drawn.
    pub mark: Mark,
    /// Points that an axis cannot show are left out.
    pub points: Vec<Point>,
}

impl Series {
    /// A line through pairs of x and y.
    pub fn line(name: &str, color: usize, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        let points = points.into_iter().map(|(x, y)| Point {
            x,
            y,
            ..Point::default()
        });
        Self {
            name: name.into(),
            color: Some(color),
            mark: Mark::Line,
            points: points.collect(),
        }
    }

    /// The mean over the last `window` values at every point.
    pub fn running_mean(&self, window: usize) -> Self {
        let mean = |k: usize| {
            let part = &self.points[(k + 1).saturating_sub(window.max(1))..=k];
            let sum: f64 = part.iter().map(|p| p.y).sum();
            (self.points[k].x, sum / part.len() as f64)
        };
        let name = format!("mean of {window}");
        Self::line(
            &name,
            self.color.unwrap_or(0),
            (0..self.points.len()).map(mean),
        )
    }
}

/// One pair of axes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// Above it; empty for nothing.
    pub title: String,
    /// In the order of drawing.
    pub series: Vec<Series>,
    /// Joined by a line: the Pareto front.
    pub front: Vec<(f64, f64)>,
    /// Ringed: the elbow of the front.
    pub elbow: Option<(f64, f64)>,
}

/// Panels with common labels and a common legend.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chart {
    /// The horizontal axis of every panel.
    pub x: Scale,
    /// The vertical axis of every panel.
    pub y: Scale,
    /// Width and height of a panel, in pixels.
    pub size: [f32; 2],
    /// From left to right.
    pub panels: Vec<Panel>,
}

/// Room for labels, in pixels.
const LEFT: f32 = 58.0;
const RIGHT: f32 = 20.0;
const BETWEEN: f32 = 50.0;
const BELOW: f32 = 50.0;
const TITLE: f32 = 30.0;
const NO_TITLE: f32 = 10.0;
const LEGEND_ROW: f32 = 17.0;
const LEGEND_COLUMN: f32 = 190.0;
/// Most points that are drawn of a series: more than a screen shows.
const MOST_POINTS: usize = 800;

impl Chart {
    /// Points that the axes can show.
    pub fn visible_points(&self) -> usize {
        let series = self.panels.iter().flat_map(|p| &p.series);
        let points = series.flat_map(|s| &s.points);
        points.filter(|p| self.shows(p)).count()
    }

    fn shows(&self, point: &Point) -> bool {
        self.x.shows(point.x) && self.y.shows(point.y)
    }

    /// The numbers behind the lines and dots: `panel,series,x,y`.
    pub fn to_csv(&self) -> String {
        let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
        let mut csv = format!("panel,series,{},y\n", quoted(&self.x.label));
        for panel in &self.panels {
            for series in &panel.series {
                let names = format!("{},{}", quoted(&panel.title), quoted(&series.name));
                for point in &series.points {
                    csv += &format!("{names},{},{}\n", point.x, point.y);
                }
            }
        }
        csv
    }

    /// The picture.
    pub fn draw(&self) -> Drawing {
        let legend = self.legend();
        let panel = Vec2::from_array(self.size);
        let panels = self.panels.len().max(1) as f32;
        let titled = self.panels.iter().any(|p| !p.title.is_empty());
        let top = if titled { TITLE } else { NO_TITLE };
        let left = if self.y.label.is_empty() {
            LEFT - 14.0
        } else {
            LEFT
        };
        let width = left + panels * panel.x + (panels - 1.0) * BETWEEN + RIGHT;
        let columns = ((width - left) / LEGEND_COLUMN).floor().max(1.0) as usize;
        let named = legend.iter().filter(|(name, _)| !name.is_empty());
        let rows = named.clone().count().div_ceil(columns);
        let height = top + panel.y + BELOW + rows as f32 * LEGEND_ROW;
        let mut drawing = Drawing::new(width as usize, height as usize);
        for (k, shown) in self.panels.iter().enumerate() {
            let low = Vec2::new(left + k as f32 * (panel.x + BETWEEN), top);
            self.draw_panel(&mut drawing, shown, low, low + panel, &legend);
        }
        let middle = Vec2::new(15.0, top + 0.5 * panel.y);
        drawing.text_upwards(middle, 12.0, Anchor::Middle, &self.y.label, Color::Ink);
        for (k, (name, color)) in named.enumerate() {
            let x = left + (k % columns) as f32 * LEGEND_COLUMN;
            let y = top + panel.y + BELOW + (k / columns) as f32 * LEGEND_ROW;
            drawing.disc(Vec2::new(x + 4.0, y), 4.0, *color);
            let beside = Vec2::new(x + 13.0, y + 4.0);
            drawing.text(beside, 11.0, Anchor::Start, name, Color::Ink);
        }
        drawing
    }

    /// Names of all series with their colours, in the order in which they first appear.
    fn legend(&self) -> Vec<(&str, Color)> {
        let mut legend: Vec<(&str, Color)> = Vec::new();
        for series in self.panels.iter().flat_map(|p| &p.series) {
            if legend.iter().all(|(name, _)| *name != series.name) {
                let color = series.color.unwrap_or(legend.len());
                legend.push((&series.name, Color::Series(color)));
            }
        }
        legend
    }

    fn draw_panel(
        &self,
        drawing: &mut Drawing,
        panel: &Panel,
        low: Vec2,
        high: Vec2,
        legend: &[(&str, Color)],
    ) {
        let points = || panel.series.iter().flat_map(|s| &s.points);
        let visible = || points().filter(|p| self.shows(p));
        // Dots on the frame would be cut in half.
        let padded = panel.series.iter().any(|s| s.mark == Mark::Dots);
        let x = Axis::new(&self.x, visible().map(|p| p.x), padded, (low.x, high.x));
        let y = Axis::new(&self.y, visible().map(|p| p.y), padded, (high.y, low.y));
        self.draw_axes(drawing, &x, &y, panel);
        let place = |(a, b): (f64, f64)| Vec2::new(x.at(a), y.at(b));
        let front = panel.front.iter().map(|p| place(*p));
        drawing.line(front, 1.5, Color::Soft);
        for series in &panel.series {
            let of_name = legend.iter().find(|(name, _)| *name == series.name);
            let color = series.color.map(Color::Series);
            let color = color.or(of_name.map(|l| l.1)).unwrap_or(Color::Ink);
            let shown: Vec<&Point> = series.points.iter().filter(|p| self.shows(p)).collect();
            match series.mark {
                Mark::Line => drawing.line(thinned(&shown).map(place), 1.8, color),
                Mark::Faint => drawing.faint_line(thinned(&shown).map(place), color),
                Mark::Dots => draw_dots(drawing, &shown, &x, &y, color),
            }
        }
        if let Some(elbow) = panel.elbow {
            drawing.ring(place(elbow), 7.5, 1.5, Color::Ink);
        }
    }

    fn draw_axes(&self, drawing: &mut Drawing, x: &Axis, y: &Axis, panel: &Panel) {
        let (left, right, bottom, top) = (x.from, x.to, y.from, y.to);
        for tick in x.ticks() {
            let at = x.at(tick);
            drawing.line(
                [Vec2::new(at, top), Vec2::new(at, bottom)],
                1.0,
                Color::Grid,
            );
            let below = Vec2::new(at, bottom + 15.0);
            drawing.text(
                below,
                10.0,
                Anchor::Middle,
                &crate::number(tick),
                Color::Ink,
            );
        }
        for tick in y.ticks() {
            let at = y.at(tick);
            drawing.line(
                [Vec2::new(left, at), Vec2::new(right, at)],
                1.0,
                Color::Grid,
            );
            let beside = Vec2::new(left - 5.0, at + 3.5);
            drawing.text(beside, 10.0, Anchor::End, &crate::number(tick), Color::Ink);
        }
        let corners = [(left, top), (left, bottom), (right, bottom)];
        drawing.line(corners.map(|(a, b)| Vec2::new(a, b)), 1.0, Color::Ink);
        let middle = 0.5 * (left + right);
        let above = Vec2::new(middle, top - 10.0);
        drawing.text(above, 12.0, Anchor::Middle, &panel.title, Color::Ink);
        let below = Vec2::new(middle, bottom + 32.0);
        drawing.text(below, 12.0, Anchor::Middle, &self.x.label, Color::Ink);
    }
}

fn draw_dots(drawing: &mut Drawing, points: &[&Point], x: &Axis, y: &Axis, color: Color) {
    // Many dots are small ones.
    let radius = if points.len() > 100 { 2.0 } else { 3.5 };
    let every = points.len().div_ceil(MOST_POINTS).max(1);
    for point in points.iter().step_by(every) {
        let at = Vec2::new(x.at(point.x), y.at(point.y));
        if let Some((low, high)) = point.interval {
            let end = |v: f64| Vec2::new(at.x, y.at(v.clamp(y.low, y.high)));
            drawing.line([end(low), end(high)], 1.0, color);
        }
        drawing.disc(at, radius, color);
        let beside = at + Vec2::new(6.0, -5.0);
        drawing.text(beside, 10.0, Anchor::Start, &point.label, Color::Ink);
    }
}

/// Means over neighbours where there are more points than a screen shows.
fn thinned<'a>(points: &'a [&Point]) -> impl Iterator<Item = (f64, f64)> + 'a {
    let chunk = points.len().div_ceil(MOST_POINTS).max(1);
    points.chunks(chunk).map(|part| {
        let n = part.len() as f64;
        let sum = part.iter().fold((0.0, 0.0), |s, p| (s.0 + p.x, s.1 + p.y));
        (sum.0 / n, sum.1 / n)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOG: fn(&str) -> Scale = |label| Scale {
        label: label.into(),
        log: true,
        range: None,
    };

    fn dots() -> Chart {
        let dot = |x, y, label: &str| Point {
            x,
            y,
            interval: Some((y * 0.9, y * 1.1)),
            label: label.into(),
        };
        let panel = Panel {
            title: "matte".into(),
            series: vec![Series {
                name: "samples".into(),
                mark: Mark::Dots,
                points: vec![
                    dot(0.1, 0.02, ""),
                    dot(1.0, 0.005, "standard"),
                    dot(0.0, 1.0, ""),
                ],
                ..Series::default()
            }],
            front: vec![(0.1, 0.02), (1.0, 0.005)],
            elbow: Some((1.0, 0.005)),
        };
        Chart {
            x: LOG("seconds"),
            y: LOG("error"),
            size: [330.0, 300.0],
            panels: vec![panel.clone(), panel],
        }
    }

    fn line(points: Vec<(f64, f64)>, log: bool) -> Chart {
        let y = Scale {
            log,
            ..Scale::default()
        };
        Chart {
            y,
            size: [500.0, 200.0],
            panels: vec![Panel {
                series: vec![Series::line("a & b", 0, points)],
                ..Panel::default()
            }],
            ..Chart::default()
        }
    }

    #[test]
    fn a_chart_shows_its_names_labels_and_round_ticks() {
        let svg = dots().draw().to_svg();
        assert_eq!(svg.matches(">samples</text>").count(), 1);
        assert_eq!(svg.matches(">standard</text>").count(), 2);
        for part in [
            ">0.1<",
            ">0.2<",
            ">1<",
            ">0.01<",
            ">0.005<",
            ">seconds<",
            ">error<",
        ] {
            assert!(svg.contains(part), "{part}");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }

    #[test]
    fn what_is_not_finite_is_left_out_and_the_rest_fills_the_frame() {
        let chart = line(vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)], false);
        assert_eq!(chart.visible_points(), 2);
        let svg = chart.draw().to_svg();
        assert!(svg.contains("points=\"44.0,210.0 544.0,10.0\""), "{svg}");
        assert!(svg.contains("a &amp; b") && !svg.contains("NaN"), "{svg}");
    }

    #[test]
    fn a_logarithmic_axis_takes_positive_values() {
        let chart = line(vec![(0.0, 0.0), (1.0, 1e-3), (2.0, 10.0)], true);
        assert_eq!(chart.visible_points(), 2);
        assert_eq!(
            line(vec![(0.0, -1.0), (1.0, 0.0)], true).visible_points(),
            0
        );
    }

    #[test]
    fn nothing_to_draw_is_an_empty_frame() {
        let empty = line(Vec::new(), true);
        assert!(empty.draw().to_svg().contains("polyline"));
        assert_eq!(empty.draw().to_pixels(1).width, 564);
    }

    #[test]
    fn the_running_mean_of_a_constant_is_that_constant() {
        let series = Series::line("", 0, (0..9).map(|k| (f64::from(k), 2.0)));
        assert_eq!(series.running_mean(4).points, series.points);
    }

    #[test]
    fn numbers_behind_the_lines_are_csv_with_quoted_names() {
        let mut chart = line(vec![(0.0, 0.5), (1.0, 0.25)], false);
        chart.panels[0].series[0].name = "a \"b\", c".into();
        assert_eq!(
            chart.to_csv(),
            "panel,series,\"\",y\n\"\",\"a \"\"b\"\", c\",0,0.5\n\"\",\"a \"\"b\"\", c\",1,0.25\n"
        );
    }
}
