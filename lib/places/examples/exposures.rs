//! How well two photographs of a place tell how they are exposed beside each other:
//! `cargo run -p dipir-places --example exposures -- PANORAMAS`. Each pair has one camera and curve, any of those that
//! training draws, and an exposure each; the second is turned.
use std::f32::consts::TAU;
use std::path::PathBuf;

use dipir_imaging::raster::LinearImage;
use dipir_light::luminance::luminance;
use dipir_numerics::stats::median;
use dipir_places::place::{SMOOTH, read_places};
use dipir_places::view::View;
use dipir_scene::exposure::Cells;
use glam::Mat3;

/// Pairs of each place.
const PAIRS: usize = 6;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let Some(folder) = std::env::args().nth(1) else {
        return Err("usage: exposures PANORAMAS".into());
    };
    let places = read_places(&PathBuf::from(folder))?;
    println!(
        "| turned by, deg | exposures differ, stops | told | off, stops | 90% below | other places |"
    );
    println!("|--:|--:|--:|--:|--:|--:|");
    for columns in [1, 2, 4, 6] {
        let turn = columns as f32 / SMOOTH[0] as f32 * TAU;
        let (mut differ, mut off, mut others) = (Vec::new(), Vec::new(), 0);
        for (p, k) in (0..places.len()).flat_map(|p| (0..PAIRS).map(move |k| (p, k))) {
            let view = View::drawn(9, p, k);
            let turned = View {
                heading: view.heading + columns,
                stops: View::drawn(10, p, k).stops,
                ..view.clone()
            };
            let mut camera = turned.camera();
            camera.rotation = Mat3::from_rotation_y(-turn) * camera.rotation;
            let cells = |image: &LinearImage, camera| Cells::new(image, camera, false);
            let (first, of_first, _) = view.photograph(&places[p], 1);
            let (second, of_second, _) = turned.photograph(&places[p], 2);
            let (elsewhere, _, _) = turned.photograph(&places[(p + 17) % places.len()], 3);
            let first = cells(&first, view.camera());
            let stops = f64::from((luminance(of_second) / luminance(of_first)).log2());
            differ.push(stops.abs());
            let told = first.stops_to(&cells(&second, camera), None);
            off.extend(told.map(|told| (told - stops).abs()));
            others += usize::from(first.stops_to(&cells(&elsewhere, camera), None).is_some());
        }
        off.sort_by(f64::total_cmp);
        let share = |n: usize| 100.0 * n as f64 / differ.len() as f64;
        println!(
            "| {:.0} | {:.2} | {:.0}% | {:.3} | {:.2} | {:.0}% |",
            turn.to_degrees(),
            median(&differ).unwrap_or(f64::NAN),
            share(off.len()),
            median(&off).unwrap_or(f64::NAN),
            off.get(off.len() * 9 / 10).copied().unwrap_or(f64::NAN),
            share(others)
        );
    }
    Ok(())
}
