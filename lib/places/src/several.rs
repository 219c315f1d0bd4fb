//! The light from several photographs of a place, each of which looks another way.
use std::f32::consts::TAU;

use dipir_estimator::{
    BORDER_DEG, Estimator, LightEstimate, ViewEstimate, Visible, combine, overlaid,
};
use dipir_imaging::raster::LinearImage;
use dipir_light::luminance::luminance;
use dipir_numerics::stats::median;
use dipir_scene::camera::Camera;
use glam::Mat3;
use rayon::prelude::*;

use crate::examples::{Example, Seen};
use crate::figures::{Case, Figures, figures, picture_error};
use crate::left_out::LeftOut;
use crate::place::{Place, SMOOTH};
use crate::probes::Probes;
use crate::view::View;

/// Photographs of each place, around the horizon.
const AROUND: usize = 8;

/// Figures over sets of photographs.
#[derive(Clone, Debug)]
pub struct Row {
    /// Photographs of a place that are combined.
    pub count: usize,
    /// Whether it is known how each is exposed beside the first.
    pub exposed: bool,
    /// All sets.
    pub all: Figures,
    /// Those of places with a sun.
    pub sunny: Option<Figures>,
    /// Median error of surfaces, where the light shows what the photographs beside the first show.
    pub shown: f64,
}

/// One photograph of a place.
struct Shot {
    example: Example,
    estimate: LightEstimate,
    photo: LinearImage,
    camera: Camera,
    heading: usize,
    gain: f32,
}

/// Combines 1, 2, 4 and 8 photographs of each place, seen by networks that were not trained on it.
/// `any` draws any camera and exposure, else photographs are as the evaluation takes them.
pub fn run(left_out: &LeftOut, any: bool) -> Vec<Row> {
    let LeftOut {
        places,
        networks,
        fold,
        ..
    } = left_out;
    let probes = Probes::seen(0.8, Some(0.3));
    let shots: Vec<Shot> = (0..places.len() * AROUND)
        .into_par_iter()
        .map(|k| Shot::take(places, k, any, &networks[fold[k / AROUND]], &probes))
        .collect();
    let sets = [
        (1, true),
        (2, true),
        (4, true),
        (8, true),
        (2, false),
        (4, false),
        (8, false),
    ];
    let row = |(count, exposed): (usize, bool)| {
        let of = |k: usize| {
            let step = AROUND / count;
            let place = k / AROUND;
            let set: Vec<&Shot> = (0..count)
                .map(|n| &shots[place * AROUND + (k + n * step) % AROUND])
                .collect();
            combined(&set, exposed, &places[place].kind, fold[place], &probes)
        };
        let found: Vec<(Case, f64)> = (0..shots.len()).into_par_iter().map(of).collect();
        let (cases, errors): (Vec<Case>, Vec<f64>) = found.into_iter().unzip();
        let mut all = figures(&cases, &probes).into_iter();
        Row {
            count,
            exposed,
            all: all
                .next()
                .unwrap_or_else(|| unreachable!("there are photographs")),
            sunny: all.find(|f| f.of == "with a sun"),
            shown: median(&errors).unwrap_or(f64::NAN),
        }
    };
    sets.into_iter().map(row).collect()
}

impl Shot {
    fn take(places: &[Place], k: usize, any: bool, network: &Estimator, probes: &Probes) -> Self {
        let (place, n) = (k / AROUND, k % AROUND);
        let heading = (n * SMOOTH[0] / AROUND + 7 * place) % SMOOTH[0];
        let view = match any {
            true => View {
                heading,
                ..View::drawn(5, place, n)
            },
            false => View::standard(heading),
        };
        let seed = (k as u64) << 20;
        let seen = Seen {
            probes,
            tuned: network.tuned(),
        };
        let example = Example::new(&places[place], place, &view, &seen, seed);
        let (photo, gain, _) = view.photograph(&places[place], seed);
        Self {
            estimate: network.of_features(&example.features, example.reference, 0.0),
            example,
            photo,
            camera: view.camera(),
            heading,
            gain: luminance(gain),
        }
    }
}

/// What a set gives, relative to its first photograph, and the error of surfaces with what the others show.
fn combined(set: &[&Shot], exposed: bool, kind: &str, fold: usize, probes: &Probes) -> (Case, f64) {
    let first = set[0];
    let turn = |s: &Shot| (s.heading as f32 - first.heading as f32) / SMOOTH[0] as f32 * TAU;
    let view = |s: &&Shot| {
        let mut estimate = s.estimate.clone();
        estimate.heading_rad = f64::from(turn(s));
        let stops = f64::from((s.gain / first.gain).log2());
        ViewEstimate {
            estimate,
            stops: exposed.then_some(stops),
        }
    };
    let views: Vec<ViewEstimate> = set.iter().map(view).collect();
    let estimate = combine(&views).unwrap_or_else(|e| unreachable!("{e}"));
    let show = |light, (s, view): (&&Shot, &ViewEstimate)| {
        let Some(stops) = view.stops else {
            return light;
        };
        let mut camera = s.camera;
        camera.rotation = Mat3::from_rotation_y(-turn(s)) * camera.rotation;
        let seen = Visible::new(&s.photo, &camera, SMOOTH[0], SMOOTH[1], BORDER_DEG);
        overlaid(&seen.scaled((-stops).exp2() as f32), &light)
    };
    let shown = set.iter().zip(&views).skip(1).fold(estimate.map(), show);
    let case = Case {
        example: first.example.clone(),
        estimate,
        kind: kind.into(),
        fold,
        histograms: Default::default(),
    };
    let error = picture_error(&probes.of_smooth(&shown, 0), &case.truth(), probes);
    (case, error)
}

/// The rows as a table in Markdown.
pub fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| photographs | exposures | error | with what is seen | exposure off, stops | within .5 | peak off, deg | of a sun \
         | azimuth held (arc) | elevation held | exposure held | share held |\n\
         |--:|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for row in rows {
        let r = &row.all;
        let held = |k: usize, digits: usize| {
            format!("{:.0}% ({:.digits$})", 100.0 * r.coverage[k], r.length[k])
        };
        text += &format!(
            "| {} | {} | {:.3} | {:.3} | {:.2} | {:.0}% | {:.0} | {:.0} | {} | {} | {} | {} |\n",
            row.count,
            if row.exposed { "known" } else { "not known" },
            r.estimate,
            row.shown,
            r.stops,
            100.0 * r.half_stop,
            r.peak_deg,
            row.sunny.as_ref().map_or(f64::NAN, |f| f.peak_deg),
            held(0, 0),
            held(1, 0),
            held(2, 1),
            held(3, 2),
        );
    }
    text
}
