//! What scores of many scenes say together.
use std::fmt::Write as _;

use dipir_evaluation::scores::PictureScores;
use dipir_evaluation::summary::Summary;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;
use serde::Serialize;

use super::Scored;
use super::scene::SIDE;

/// Pictures are enlarged by this on the sheet.
const ENLARGED: usize = 2;

/// One light over some scenes.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// The light.
    pub light: String,
    /// RMSE touched.
    pub touched: Summary,
    /// RMSE, SSIM, si-RMSE of whole pictures, si-RMSE of the object: medians.
    pub whole: [f64; 4],
    /// How often it is better than neutral light, and than neutral light times a constant.
    pub better: [f64; 2],
}

impl Scored {
    fn of(&self, light: &str) -> Option<&PictureScores> {
        self.scores.iter().find(|s| s.0 == light).map(|s| &s.1)
    }

    fn touched(&self, light: &str) -> f64 {
        self.of(light).map_or(f64::NAN, |s| s.rmse_touched)
    }
}

/// Adds neutral light and the estimate times the constant that is best on the other folds, and times the factor that is
/// best for each scene.
pub fn add_constants(scenes: &mut [Scored], factors: &[f32]) {
    let folds = scenes.iter().map(|s| s.fold).max().map_or(0, |f| f + 1);
    // Places of one fold alone have no others.
    let alone = scenes.windows(2).all(|w| w[0].fold == w[1].fold);
    for (n, name) in ["neutral", "estimate"].into_iter().enumerate() {
        let best: Vec<usize> = (0..folds)
            .map(|f| {
                let error = |k: usize| -> f64 {
                    let others = scenes.iter().filter(|s| s.fold != f || alone);
                    others.map(|s| s.exposed[n][k].rmse_touched).sum()
                };
                (0..factors.len())
                    .min_by(|a, b| error(*a).total_cmp(&error(*b)))
                    .unwrap_or(0)
            })
            .collect();
        for s in scenes.iter_mut() {
            let errors = &s.exposed[n];
            let own = (0..factors.len())
                .min_by(|a, b| errors[*a].rmse_touched.total_cmp(&errors[*b].rmse_touched))
                .unwrap_or(0);
            let (constant, own) = (errors[best[s.fold]], errors[own]);
            s.scores.push((format!("{name} x constant"), constant));
            s.scores.push((format!("{name}, best exposure"), own));
        }
    }
}

/// Figures of each light over the scenes that `test` holds for.
fn rows(scenes: &[Scored], test: &dyn Fn(&Scored) -> bool) -> Vec<Row> {
    let some: Vec<&Scored> = scenes.iter().filter(|s| test(s)).collect();
    let Some(first) = some.first() else {
        return Vec::new();
    };
    let row = |(light, _): &(String, PictureScores)| {
        let median = |value: &dyn Fn(&PictureScores) -> f64| {
            let all: Vec<f64> = some.iter().filter_map(|s| s.of(light).map(value)).collect();
            dipir_numerics::stats::median(&all).unwrap_or(f64::NAN)
        };
        let all: Vec<f64> = some.iter().map(|s| s.touched(light)).collect();
        let better = |than: &str| {
            let count = some
                .iter()
                .filter(|s| s.touched(light) < s.touched(than))
                .count();
            count as f64 / some.len() as f64
        };
        Some(Row {
            light: light.clone(),
            touched: Summary::of(&all, 0)?,
            whole: [
                median(&|s| s.rmse),
                median(&|s| s.ssim),
                median(&|s| s.si_rmse),
                median(&|s| s.si_rmse_object),
            ],
            better: [better("neutral"), better("neutral x constant")],
        })
    };
    first.scores.iter().filter_map(row).collect()
}

/// All tables, as Markdown.
pub fn all(scenes: &[Scored]) -> String {
    let mut text = String::from(
        "| light | RMSE touched, median (95%) | mean | RMSE | SSIM | si-RMSE | si-RMSE object | better than neutral | than x constant |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for r in rows(scenes, &|_| true) {
        let [rmse, ssim, si, object] = r.whole;
        let _ = writeln!(
            text,
            "| {} | {} | {:.3} | {rmse:.3} | {ssim:.3} | {si:.3} | {object:.3} | {:.0}% | {:.0}% |",
            r.light,
            r.touched.text(3),
            r.touched.mean,
            100.0 * r.better[0],
            100.0 * r.better[1]
        );
    }
    text += "\n| places | scenes | neutral | neutral x constant | estimate | estimate, best exposure | better than neutral |\n|---|--:|--:|--:|--:|--:|--:|\n";
    let mut kinds: Vec<&str> = scenes.iter().map(|s| s.kind.as_str()).collect();
    kinds.sort_unstable();
    kinds.dedup();
    let mut add = |name: &str, test: &dyn Fn(&Scored) -> bool| {
        let rows = rows(scenes, test);
        let of = |light: &str| rows.iter().find(|r| r.light == light);
        let cell = |light: &str| {
            of(light).map_or(String::new(), |r| {
                format!("{:.3} ({:.3})", r.touched.median, r.touched.mean)
            })
        };
        let count = scenes.iter().filter(|s| test(s)).count();
        let better = of("estimate").map_or(f64::NAN, |r| 100.0 * r.better[0]);
        let _ = writeln!(
            text,
            "| {name} | {count} | {} | {} | {} | {} | {better:.0}% |",
            cell("neutral"),
            cell("neutral x constant"),
            cell("estimate"),
            cell("estimate, best exposure"),
        );
    };
    add("with a sun", &|s| s.sun);
    add("without", &|s| !s.sun);
    for kind in kinds {
        add(kind, &|s| s.kind == kind);
    }
    text + &worst(scenes)
}

/// The scenes in which the estimate is most worse than neutral light.
fn worst(scenes: &[Scored]) -> String {
    let mut worst: Vec<(f64, &Scored)> = scenes
        .iter()
        .map(|s| (s.touched("estimate") - s.touched("neutral"), s))
        .filter(|(difference, _)| *difference > 0.0)
        .collect();
    worst.sort_by(|a, b| b.0.total_cmp(&a.0));
    let named = worst
        .iter()
        .take(12)
        .map(|(d, s)| format!("{} ({d:+.3})", s.name));
    let named: Vec<String> = named.collect();
    match named.is_empty() {
        true => "\nWorse than neutral light: none\n".into(),
        false => format!("\nMost worse than neutral light: {}\n", named.join(", ")),
    }
}

/// Rows of pictures of `count` scenes evenly drawn from all.
pub fn sheet(scenes: &[Scored], count: usize) -> DisplayImage {
    let count = count.min(scenes.len());
    let chosen: Vec<&Scored> = (0..count)
        .map(|k| &scenes[k * scenes.len() / count])
        .collect();
    let columns = chosen.first().map_or(1, |s| s.pictures.len());
    // Two scenes side by side.
    let across = 2 * columns;
    let side = SIDE * ENLARGED;
    let (width, height) = (across * side, chosen.len().div_ceil(2).max(1) * side);
    let pixel = |k: usize| {
        let (x, y) = (k % width, k / width);
        let scene = chosen.get(y / side * 2 + x / side / columns);
        let picture = scene.and_then(|s| s.pictures.get(x / side % columns));
        picture.map_or(Vec3::ZERO, |p| {
            *p.0.get(x % side / ENLARGED, y % side / ENLARGED)
        })
    };
    DisplayImage(Raster::from_pixels(
        width,
        height,
        (0..width * height).map(pixel).collect(),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_with_room_for_more_scenes_shows_each_once() {
        let scene = |value: f32| Scored {
            name: String::new(),
            kind: String::new(),
            fold: 0,
            sun: false,
            scores: vec![],
            exposed: Default::default(),
            pictures: vec![DisplayImage(Raster::filled(SIDE, SIDE, Vec3::splat(value)))],
        };
        let shown = sheet(&[0.25, 0.5, 0.75].map(scene), 24).0;
        let side = SIDE * ENLARGED;
        let at = |column: usize, row: usize| shown.get(column * side, row * side).x;
        assert_eq!((shown.width(), shown.height()), (2 * side, 2 * side));
        let all = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
        assert_eq!(all, [0.25, 0.5, 0.75, 0.0]);
    }

    #[test]
    fn only_scenes_that_are_worse_are_named_as_worse() {
        let scene = |name: &str, estimate: f64| {
            let score = |rmse_touched: f64| PictureScores {
                rmse: 0.0,
                ssim: 1.0,
                si_rmse: 0.0,
                rmse_touched,
                si_rmse_object: 0.0,
            };
            Scored {
                name: name.into(),
                kind: String::new(),
                fold: 0,
                sun: false,
                scores: vec![
                    ("neutral".into(), score(0.5)),
                    ("estimate".into(), score(estimate)),
                ],
                exposed: Default::default(),
                pictures: vec![],
            }
        };
        let scenes = [
            scene("a", 0.25),
            scene("b", 0.75),
            scene("c", 1.0),
            scene("d", 0.5),
        ];
        assert_eq!(
            worst(&scenes),
            "\nMost worse than neutral light: c (+0.500), b (+0.250)\n"
        );
        assert_eq!(worst(&scenes[..1]), "\nWorse than neutral light: none\n");
    }

    #[test]
    fn scenes_of_one_fold_alone_get_the_constant_that_is_best_for_them() {
        let errors = |best: usize| -> Vec<PictureScores> {
            let at = |k: usize| PictureScores {
                rmse: 0.0,
                ssim: 1.0,
                si_rmse: 0.0,
                rmse_touched: k.abs_diff(best) as f64,
                si_rmse_object: 0.0,
            };
            (0..5).map(at).collect()
        };
        let scene = |fold: usize, best: usize| Scored {
            name: "yard".into(),
            kind: "place".into(),
            fold,
            sun: false,
            scores: Vec::new(),
            exposed: [errors(best), errors(best)],
            pictures: Vec::new(),
        };
        let found = |mut scenes: Vec<Scored>| {
            add_constants(&mut scenes, &[1.0; 5]);
            scenes[0].touched("neutral x constant")
        };
        assert_eq!(found(vec![scene(2, 3), scene(2, 3)]), 0.0);
        assert_eq!(found(vec![scene(2, 3), scene(0, 1)]), 2.0);
    }
}
