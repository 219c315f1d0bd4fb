//! Line plots as inline SVG, coloured by the page's style.
use super::html::Html;

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// A line.
    Line,
    /// A thin line behind the others: raw values of a noisy quantity.
    Faint,
    /// A dot a point.
    Dots,
}

/// Points that belong together.
#[derive(Clone, Debug)]
pub struct Series {
    /// For the legend; empty for none.
    pub name: String,
    /// Number of its colour, 0 to 3.
    pub color: usize,
    /// How it is drawn.
    pub mark: Mark,
    /// x and y; points that are not finite are left out.
    pub points: Vec<(f64, f64)>,
}

/// A plot.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// Above it.
    pub title: String,
    /// Below it.
    pub x_label: String,
    /// Whether the vertical axis is logarithmic; values that are not positive are left out.
    pub log_y: bool,
    /// The range of the vertical axis, else that of the values.
    pub y_range: Option<(f64, f64)>,
    /// In the order of drawing.
    pub series: Vec<Series>,
}

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 280.0;
const LEFT: f64 = 62.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = 42.0;
/// Points of a line at most: more than a screen shows.
const MOST_POINTS: usize = 800;

/// Values to places along an axis.
struct Axis {
    low: f64,
    high: f64,
    log: bool,
    from: f64,
    to: f64,
}

impl Axis {
    fn at(&self, value: f64) -> f64 {
        let map = |v: f64| if self.log { v.ln() } else { v };
        let share = (map(value) - map(self.low)) / (map(self.high) - map(self.low));
        self.from + share * (self.to - self.from)
    }

    /// Round values, five or so.
    fn ticks(&self) -> Vec<f64> {
        if self.log {
            let (first, last) = (
                self.low.log10().ceil() as i32,
                self.high.log10().floor() as i32,
            );
            let step = ((last - first) / 5).max(1) as usize;
            let decades: Vec<f64> = (first..=last)
                .step_by(step)
                .map(|e| 10f64.powi(e))
                .collect();
            if decades.len() >= 2 {
                return decades;
            }
        }
        let step = nice((self.high - self.low) / 5.0);
        let first = (self.low / step).ceil() as i64;
        (first..first + 20)
            .map(|k| k as f64 * step)
            .take_while(|v| *v <= self.high + 1e-9 * step)
            .collect()
    }
}

/// The nearest of 1, 2, 5 times a power of ten, not below `step`.
fn nice(step: f64) -> f64 {
    let power = 10f64.powf(step.log10().floor());
    let factor = [1.0, 2.0, 5.0, 10.0];
    let factor = factor
        .into_iter()
        .find(|f| f * power >= step * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

impl Plot {
    /// The plot with its legend; nothing if there are no two points to draw.
    pub fn render(&self) -> Option<Html> {
        let usable =
            |p: &&(f64, f64)| p.0.is_finite() && p.1.is_finite() && (!self.log_y || p.1 > 0.0);
        let all = || {
            self.series
                .iter()
                .flat_map(|s| s.points.iter().filter(usable))
        };
        if all().count() < 2 {
            return None;
        }
        let range = |f: fn(&(f64, f64)) -> f64| {
            all()
                .map(f)
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                    (low.min(v), high.max(v))
                })
        };
        let (x_low, x_high) = apart(range(|p| p.0), false);
        let (y_low, y_high) = self
            .y_range
            .unwrap_or_else(|| apart(range(|p| p.1), self.log_y));
        let x = Axis {
            low: x_low,
            high: x_high,
            log: false,
            from: LEFT,
            to: WIDTH - RIGHT,
        };
        let y = Axis {
            low: y_low,
            high: y_high,
            log: self.log_y,
            from: HEIGHT - BOTTOM,
            to: TOP,
        };
        let mut parts = axes(&x, &y, &self.x_label);
        for series in &self.series {
            let points: Vec<_> = series.points.iter().filter(usable).copied().collect();
            parts.extend(draw(series, &thinned(&points), &x, &y));
        }
        let view = format!("0 0 {WIDTH} {HEIGHT}");
        let attributes = [
            ("viewBox", view.as_str()),
            ("role", "img"),
            ("aria-label", self.title.as_str()),
        ];
        let figure = [
            Html::of("figcaption", &self.title),
            Html::element("svg", &attributes, parts),
            self.legend(),
        ];
        Some(Html::element("figure", &[("class", "plot")], figure))
    }

    fn legend(&self) -> Html {
        let named = self.series.iter().filter(|s| !s.name.is_empty());
        let entries = named.map(|s| {
            let class = format!("key c{}", s.color % 4);
            let key = Html::element("span", &[("class", &class)], []);
            Html::element("span", &[], [key, Html::text(&s.name)])
        });
        Html::element("p", &[("class", "legend")], entries)
    }
}

/// A range with some room, never empty.
fn apart((low, high): (f64, f64), log: bool) -> (f64, f64) {
    if log {
        return match high > low * 1.001 {
            true => (low, high),
            false => (low * 0.5, high * 2.0),
        };
    }
    match high - low > 1e-12 * high.abs().max(1e-12) {
        true => (low, high),
        false => (low - 0.5, high + 0.5),
    }
}

/// Means over neighbours where there are more points than a screen shows.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let chunk = points.len().div_ceil(MOST_POINTS).max(1);
    let mean = |part: &[(f64, f64)]| {
        let n = part.len() as f64;
        let sum = part.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        (sum.0 / n, sum.1 / n)
    };
    points.chunks(chunk).map(mean).collect()
}

fn draw(series: &Series, points: &[(f64, f64)], x: &Axis, y: &Axis) -> Vec<Html> {
    let color = series.color % 4;
    let at = |p: &(f64, f64)| (format!("{:.1}", x.at(p.0)), format!("{:.1}", y.at(p.1)));
    if series.mark == Mark::Dots {
        let class = format!("dot c{color}");
        let dot = |p: &(f64, f64)| {
            let (cx, cy) = at(p);
            let attributes = [
                ("class", class.as_str()),
                ("cx", &cx),
                ("cy", &cy),
                ("r", "2"),
            ];
            Html::element("circle", &attributes, [])
        };
        return points.iter().map(dot).collect();
    }
    let class = match series.mark {
        Mark::Faint => format!("line faint c{color}"),
        _ => format!("line c{color}"),
    };
    let places: Vec<String> = points
        .iter()
        .map(|p| {
            let (x, y) = at(p);
            format!("{x},{y}")
        })
        .collect();
    let places = places.join(" ");
    let attributes = [("class", class.as_str()), ("points", places.as_str())];
    vec![Html::element("polyline", &attributes, [])]
}

fn axes(x: &Axis, y: &Axis, x_label: &str) -> Vec<Html> {
    let line = |x1: f64, y1: f64, x2: f64, y2: f64| {
        let v = [x1, y1, x2, y2].map(|v| format!("{v:.1}"));
        let names = ["x1", "y1", "x2", "y2"];
        let mut attributes = vec![("class", "grid")];
        attributes.extend(names.into_iter().zip(v.iter().map(String::as_str)));
        Html::element("line", &attributes, [])
    };
    let label = |at_x: f64, at_y: f64, anchor: &str, text: &str| {
        let (at_x, at_y) = (format!("{at_x:.1}"), format!("{at_y:.1}"));
        let attributes = [
            ("x", at_x.as_str()),
            ("y", at_y.as_str()),
            ("text-anchor", anchor),
        ];
        Html::element("text", &attributes, [Html::text(text)])
    };
    let mut parts = Vec::new();
    for tick in y.ticks() {
        let at = y.at(tick);
        parts.push(line(LEFT, at, WIDTH - RIGHT, at));
        parts.push(label(LEFT - 6.0, at + 4.0, "end", &number(tick)));
    }
    for tick in x.ticks() {
        let at = x.at(tick);
        parts.push(line(at, HEIGHT - BOTTOM, at, HEIGHT - BOTTOM + 4.0));
        parts.push(label(at, HEIGHT - BOTTOM + 18.0, "middle", &number(tick)));
    }
    let middle = 0.5 * (LEFT + WIDTH - RIGHT);
    parts.push(label(middle, HEIGHT - 6.0, "middle", x_label));
    parts
}

/// A number as short as it can be without lying much: three digits or so.
pub fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e5).contains(&size) {
        return format!("{value:.2e}").replace(".00e", "e");
    }
    let digits = (2 - size.log10().floor() as i32).clamp(0, 5) as usize;
    let text = format!("{value:.digits$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').into(),
        false => text,
    }
}

/// The mean over the last `window` values at every point: what a noisy series does.
pub fn running_mean(points: &[(f64, f64)], window: usize) -> Vec<(f64, f64)> {
    (0..points.len())
        .map(|k| {
            let part = &points[(k + 1).saturating_sub(window.max(1))..=k];
            let sum: f64 = part.iter().map(|p| p.1).sum();
            (points[k].0, sum / part.len() as f64)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<(f64, f64)>, log_y: bool) -> Plot {
        Plot {
            title: "<loss>".into(),
            log_y,
            series: vec![Series {
                name: "a & b".into(),
                color: 0,
                mark: Mark::Line,
                points,
            }],
            ..Plot::default()
        }
    }

    #[test]
    fn what_is_not_finite_is_left_out_and_the_rest_fills_the_frame() {
        let points = vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)];
        let html = plot(points, false).render().unwrap().into_string();
        assert!(html.contains("points=\"62.0,238.0 628.0,10.0\""), "{html}");
        assert!(
            html.contains("&lt;loss&gt;") && html.contains("a &amp; b"),
            "{html}"
        );
        assert!(!html.contains("NaN"), "{html}");
    }

    #[test]
    fn a_logarithmic_axis_takes_positive_values_and_ticks_decades() {
        let points = vec![(0.0, 0.0), (1.0, 1e-3), (2.0, 10.0)];
        let html = plot(points, true).render().unwrap().into_string();
        for tick in ["0.001", "0.01", "0.1", ">1<", ">10<"] {
            assert!(html.contains(tick), "{tick}: {html}");
        }
    }

    #[test]
    fn nothing_to_draw_is_no_plot_and_constants_are_one() {
        assert_eq!(plot(vec![(0.0, f64::NAN)], false).render(), None);
        assert_eq!(plot(vec![(0.0, -1.0), (1.0, 0.0)], true).render(), None);
        assert!(plot(vec![(0.0, 2.0), (1.0, 2.0)], false).render().is_some());
        assert!(plot(vec![(0.0, 0.0), (1.0, 0.0)], false).render().is_some());
    }

    #[test]
    fn numbers_are_short() {
        let shown: Vec<_> = [0.0, 1.0, 0.25, 1234.0, 12.345, 1e-7, 2.5e6, -0.5]
            .into_iter()
            .map(number)
            .collect();
        assert_eq!(
            shown,
            ["0", "1", "0.25", "1234", "12.3", "1e-7", "2.50e6", "-0.5"]
        );
    }

    #[test]
    fn the_running_mean_of_a_constant_is_that_constant() {
        let points: Vec<_> = (0..9).map(|k| (f64::from(k), 2.0)).collect();
        assert_eq!(running_mean(&points, 4), points);
    }
}
