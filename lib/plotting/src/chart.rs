//! Scatter plots on logarithmic axes, panels side by side: error against cost.
use glam::Vec2;

use crate::drawing::{Anchor, Color, Drawing};

/// A dot, with the interval of its error.
#[derive(Clone, Debug, PartialEq)]
pub struct Dot {
    /// Along the horizontal axis, above 0.
    pub x: f64,
    /// Along the vertical axis, above 0.
    pub y: f64,
    /// Lower and upper end of its interval.
    pub interval: Option<(f64, f64)>,
    /// Written beside it; empty for nothing.
    pub label: String,
}

/// Dots of one colour.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// For the legend.
    pub name: String,
    /// Its dots.
    pub dots: Vec<Dot>,
}

/// One pair of axes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// Dots; the nth series of every panel has the same colour.
    pub series: Vec<Series>,
    /// Joined by a line: the Pareto front.
    pub front: Vec<(f64, f64)>,
    /// Ringed: the elbow.
    pub elbow: Option<(f64, f64)>,
}

/// Panels with common axis labels and a common legend.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chart {
    /// Below every panel.
    pub x_label: String,
    /// Left of the first.
    pub y_label: String,
    /// From left to right.
    pub panels: Vec<Panel>,
}

const PANEL: Vec2 = Vec2::new(330.0, 300.0);
const LEFT: f32 = 58.0;
const TOP: f32 = 30.0;
const BETWEEN: f32 = 50.0;
const BELOW: f32 = 50.0;
const LEGEND_ROW: f32 = 17.0;
const LEGEND_COLUMN: f32 = 190.0;
const INK: Color = [40, 40, 40];
const GRID: Color = [225, 225, 225];
const FRONT: Color = [120, 120, 120];

/// Colours that people with a colour vision deficiency tell apart [Okabe and Ito 2008], then
/// darker ones.
const COLORS: [Color; 12] = [
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

/// A logarithmic axis.
struct Axis {
    low: f64,
    high: f64,
    from: f32,
    to: f32,
}

impl Axis {
    /// Room for all `values`.
    fn over(values: impl Iterator<Item = f64>, from: f32, to: f32) -> Self {
        let (low, high) = values
            .filter(|v| v.is_finite() && *v > 0.0)
            .fold((f64::INFINITY, 0f64), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if high > 0.0 { (low, high) } else { (0.1, 1.0) };
        Self {
            low: low / 1.25,
            high: high * 1.25,
            from,
            to,
        }
    }

    fn at(&self, value: f64) -> f32 {
        let share = (value / self.low).ln() / (self.high / self.low).ln();
        self.from + share as f32 * (self.to - self.from)
    }

    /// 1, 2, 5 times powers of ten where there are few decades, else the powers alone.
    fn ticks(&self) -> Vec<f64> {
        let factors: &[f64] = match (self.high / self.low).log10() > 2.5 {
            true => &[1.0],
            false => &[1.0, 2.0, 5.0],
        };
        let (first, last) = (
            self.low.log10().floor() as i32,
            self.high.log10().ceil() as i32,
        );
        (first..=last)
            .flat_map(|e| factors.iter().map(move |f| f * 10f64.powi(e)))
            .filter(|v| (self.low..=self.high).contains(v))
            .collect()
    }
}

/// A tick's label without needless zeros.
fn label(value: f64) -> String {
    match (1e-4..1e5).contains(&value) {
        true => {
            let digits = (-value.log10().floor()).max(0.0) as usize;
            format!("{value:.digits$}")
        }
        false => format!("{value:.0e}"),
    }
}

impl Chart {
    /// The picture.
    pub fn draw(&self) -> Drawing {
        let names = self.names();
        let panels = self.panels.len().max(1) as f32;
        let width = LEFT + panels * PANEL.x + (panels - 1.0) * BETWEEN + 20.0;
        let columns = ((width - LEFT) / LEGEND_COLUMN).floor().max(1.0) as usize;
        let rows = names.len().div_ceil(columns);
        let height = TOP + PANEL.y + BELOW + rows as f32 * LEGEND_ROW + 8.0;
        let mut drawing = Drawing::new(width as usize, height as usize);
        for (k, panel) in self.panels.iter().enumerate() {
            let left = LEFT + k as f32 * (PANEL.x + BETWEEN);
            self.draw_panel(&mut drawing, panel, left, &names);
        }
        let middle = Vec2::new(15.0, TOP + 0.5 * PANEL.y);
        drawing.text_upwards(middle, 12.0, Anchor::Middle, &self.y_label, INK);
        for (k, name) in names.iter().enumerate() {
            let x = LEFT + (k % columns) as f32 * LEGEND_COLUMN;
            let y = TOP + PANEL.y + BELOW + (k / columns) as f32 * LEGEND_ROW;
            drawing.disc(Vec2::new(x + 4.0, y), 4.0, COLORS[k % COLORS.len()]);
            drawing.text(Vec2::new(x + 13.0, y + 4.0), 11.0, Anchor::Start, name, INK);
        }
        drawing
    }

    /// Names of all series, in the order in which they first appear.
    fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for series in self.panels.iter().flat_map(|p| &p.series) {
            if !names.contains(&series.name) {
                names.push(series.name.clone());
            }
        }
        names
    }

    fn draw_panel(&self, drawing: &mut Drawing, panel: &Panel, left: f32, names: &[String]) {
        let dots = || panel.series.iter().flat_map(|s| &s.dots);
        let bottom = TOP + PANEL.y;
        let x = Axis::over(dots().map(|d| d.x), left, left + PANEL.x);
        let y = Axis::over(dots().map(|d| d.y), bottom, TOP);
        self.draw_axes(drawing, &x, &y, panel);
        let place = |(a, b): (f64, f64)| Vec2::new(x.at(a), y.at(b));
        drawing.line(panel.front.iter().map(|p| place(*p)), 1.5, FRONT);
        for series in &panel.series {
            let k = names.iter().position(|n| *n == series.name).unwrap_or(0);
            let color = COLORS[k % COLORS.len()];
            for dot in series.dots.iter().filter(|d| d.x > 0.0 && d.y > 0.0) {
                let at = place((dot.x, dot.y));
                if let Some((low, high)) = dot.interval {
                    let end = |v: f64| Vec2::new(at.x, y.at(v.max(y.low)).clamp(TOP, bottom));
                    drawing.line([end(low), end(high)], 1.0, color);
                }
                drawing.disc(at, 3.5, color);
                let beside = at + Vec2::new(6.0, -5.0);
                drawing.text(beside, 10.0, Anchor::Start, &dot.label, INK);
            }
        }
        if let Some(elbow) = panel.elbow {
            drawing.ring(place(elbow), 7.5, 1.5, INK);
        }
    }

    fn draw_axes(&self, drawing: &mut Drawing, x: &Axis, y: &Axis, panel: &Panel) {
        let (left, right, bottom) = (x.from, x.to, y.from);
        for tick in x.ticks() {
            let at = x.at(tick);
            drawing.line([Vec2::new(at, TOP), Vec2::new(at, bottom)], 1.0, GRID);
            let below = Vec2::new(at, bottom + 15.0);
            drawing.text(below, 10.0, Anchor::Middle, &label(tick), INK);
        }
        for tick in y.ticks() {
            let at = y.at(tick);
            drawing.line([Vec2::new(left, at), Vec2::new(right, at)], 1.0, GRID);
            let beside = Vec2::new(left - 5.0, at + 3.5);
            drawing.text(beside, 10.0, Anchor::End, &label(tick), INK);
        }
        let corners = [(left, TOP), (left, bottom), (right, bottom)];
        drawing.line(corners.map(|(a, b)| Vec2::new(a, b)), 1.0, INK);
        let middle = 0.5 * (left + right);
        let above = Vec2::new(middle, TOP - 10.0);
        drawing.text(above, 12.0, Anchor::Middle, &panel.title, INK);
        let below = Vec2::new(middle, bottom + 32.0);
        drawing.text(below, 12.0, Anchor::Middle, &self.x_label, INK);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        let dot = |x, y, label: &str| Dot {
            x,
            y,
            interval: Some((y * 0.9, y * 1.1)),
            label: label.into(),
        };
        let panel = Panel {
            title: "matte".into(),
            series: vec![Series {
                name: "samples".into(),
                dots: vec![
                    dot(0.1, 0.02, ""),
                    dot(1.0, 0.005, "standard"),
                    dot(0.0, 1.0, ""),
                ],
            }],
            front: vec![(0.1, 0.02), (1.0, 0.005)],
            elbow: Some((1.0, 0.005)),
        };
        Chart {
            x_label: "seconds".into(),
            y_label: "error".into(),
            panels: vec![panel.clone(), panel],
        }
    }

    #[test]
    fn a_chart_shows_its_names_labels_and_round_ticks_once_each() {
        let svg = chart().draw().to_svg();
        assert_eq!(svg.matches(">samples</text>").count(), 1);
        assert_eq!(svg.matches(">standard</text>").count(), 2);
        for tick in [">0.1<", ">0.2<", ">1<", ">0.01<", ">0.005<"] {
            assert!(svg.contains(tick), "{tick}");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }

    #[test]
    fn nothing_to_draw_is_an_empty_frame() {
        let empty = Chart {
            panels: vec![Panel::default()],
            ..Chart::default()
        };
        assert!(empty.draw().to_svg().contains("polyline"));
        assert!(empty.draw().to_image(1).0.width() > 300);
    }
}
