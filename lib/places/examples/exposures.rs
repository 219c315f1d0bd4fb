//! How well two photographs of a place tell how they are exposed and tinted beside each other:
//! `cargo run -p dipir-places --example exposures -- PANORAMAS`. Each pair has one camera and curve, any of those that
//! training draws, and an exposure each; the second is turned. The second table is of the same pairs, with one white balance
//! and with another in the second photograph, in which each channel has up to a tenth more or less.
use std::f32::consts::TAU;
use std::path::PathBuf;

use dipir_imaging::raster::LinearImage;
use dipir_light::luminance::luminance;
use dipir_numerics::sampler::{Sampler, Stream};
use dipir_numerics::stats::median;
use dipir_places::place::{Place, SMOOTH, read_places};
use dipir_places::view::View;
use dipir_scene::camera::Camera;
use dipir_scene::exposure::{Cells, Exposure};
use glam::{Mat3, Vec3};

/// Pairs of each place.
const PAIRS: usize = 6;
/// Most that a channel has more or less in another white balance.
const DRIFT: f32 = 0.1;

/// What is found of one pair.
struct Found {
    /// How the second photograph is exposed over the first.
    truth: Exposure,
    /// What the pictures tell of it.
    told: Option<Exposure>,
    /// What the first and a picture of another place tell.
    of_another: Option<Exposure>,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let Some(folder) = std::env::args().nth(1) else {
        return Err("usage: exposures PANORAMAS".into());
    };
    let places = read_places(&PathBuf::from(folder))?;
    let turns = [1, 2, 4, 6];
    let same = turns.map(|columns| (columns, pairs(&places, columns, 0.0)));
    println!(
        "| turned by, deg | exposures differ, stops | told | off, stops | 90% below | other places |"
    );
    println!("|--:|--:|--:|--:|--:|--:|");
    for (columns, found) in &same {
        let told = found.iter().filter_map(|f| Some((f.told?, f.truth)));
        let off = sorted(told.map(|(told, truth)| (told.stops - truth.stops).abs()));
        println!(
            "| {:.0} | {:.2} | {:.0}% | {:.3} | {:.2} | {:.0}% |",
            turn(*columns).to_degrees(),
            middle(&sorted(found.iter().map(|f| f.truth.stops.abs()))),
            percent(off.len(), found.len()),
            middle(&off),
            most(&off),
            percent(
                found.iter().filter(|f| f.of_another.is_some()).count(),
                found.len()
            )
        );
    }
    println!();
    println!(
        "| turned by, deg | white balance | tints differ, stops | 90% below | told | off, stops | 90% below | used, off | 90% below | none used |"
    );
    println!("|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|");
    for (columns, found) in same {
        print_tints(columns, "same", &found);
        print_tints(columns, "another", &pairs(&places, columns, DRIFT));
    }
    Ok(())
}

/// Prints a row of the second table.
fn print_tints(columns: usize, name: &str, found: &[Found]) {
    let largest = |tint: Vec3| f64::from(tint.abs().max_element());
    let of = |tint: Option<[f64; 3]>| Vec3::from(tint.unwrap_or_default().map(|t| t as f32));
    let truth = |f: &Found| of(f.truth.tint);
    let used = |f: &Found| of(f.told.and_then(|told| told.certain().tint));
    let told = found
        .iter()
        .filter(|f| f.told.is_some_and(|t| t.tint.is_some()));
    let drawn = sorted(found.iter().map(|f| largest(truth(f))));
    let raw = sorted(told.map(|f| largest(of(f.told.and_then(|told| told.tint)) - truth(f))));
    // Where nothing is told, none is used.
    let off = sorted(found.iter().map(|f| largest(used(f) - truth(f))));
    let none = found.iter().filter(|f| used(f) == Vec3::ZERO).count();
    println!(
        "| {:.0} | {name} | {:.3} | {:.3} | {:.0}% | {:.3} | {:.3} | {:.3} | {:.3} | {:.0}% |",
        turn(columns).to_degrees(),
        middle(&drawn),
        most(&drawn),
        percent(raw.len(), found.len()),
        middle(&raw),
        most(&raw),
        middle(&off),
        most(&off),
        percent(none, found.len())
    );
}

/// What pairs tell whose second is turned by so many columns. Its channels have up to `drift` more or less.
fn pairs(places: &[Place], columns: usize, drift: f32) -> Vec<Found> {
    let all = (0..places.len()).flat_map(|p| (0..PAIRS).map(move |k| (p, k)));
    all.map(|(p, k)| {
        let view = View::drawn(9, p, k);
        let mut s = Sampler::new(11, Stream::CONTENT, p as u32, k as u32);
        let mut channel = || (drift * (2.0 * s.next_1d() - 1.0)).exp();
        let turned = View {
            heading: view.heading + columns,
            stops: View::drawn(10, p, k).stops,
            white: view.white * Vec3::new(channel(), channel(), channel()),
            ..view.clone()
        };
        let mut camera = turned.camera();
        camera.rotation = Mat3::from_rotation_y(-turn(columns)) * camera.rotation;
        let (first, of_first, _) = view.photograph(&places[p], 1);
        let (second, of_second, _) = turned.photograph(&places[p], 2);
        let (elsewhere, _, _) = turned.photograph(&places[(p + 17) % places.len()], 3);
        let cells = |image: &LinearImage, camera: Camera| Cells::new(image, camera, false);
        let first = cells(&first, view.camera());
        let grey = (luminance(of_second) / luminance(of_first)).log2();
        let tint = (of_second / of_first).map(f32::log2) - (luminance(of_second / of_first)).log2();
        Found {
            truth: Exposure {
                stops: f64::from(grey),
                tint: Some(tint.to_array().map(f64::from)),
            },
            told: first.exposure_to(&cells(&second, camera), None),
            of_another: first.exposure_to(&cells(&elsewhere, camera), None),
        }
    })
    .collect()
}

fn turn(columns: usize) -> f32 {
    columns as f32 / SMOOTH[0] as f32 * TAU
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

fn middle(values: &[f64]) -> f64 {
    median(values).unwrap_or(f64::NAN)
}

/// The value below which nine of ten are.
fn most(sorted: &[f64]) -> f64 {
    let value = sorted.get(sorted.len() * 9 / 10);
    value.copied().unwrap_or(f64::NAN)
}

fn percent(n: usize, of: usize) -> f64 {
    100.0 * n as f64 / of as f64
}
