//! The frames of a shot.
use std::path::Path;

use dipir_cli::session::duration;
use dipir_imaging::file::decode_texture;
use dipir_imaging::raster::DisplayImage;
use dipir_pipeline::manifest::Manifest;
use glam::Vec3;

use super::html::Html;
use super::picture::image;
use super::{Report, Section};
use crate::names::{COMPOSITE, SCENE};
use crate::shot;

/// Frames whose pictures are shown, evenly from the first to the last.
const SHOWN: usize = 24;
/// Longest side of a picture.
const SMALL: usize = 200;

/// The frames that are made, and those that failed.
pub fn section(report: &Report) -> Section {
    let mut frames = shot::folders(&report.session.out);
    frames.retain(|frame| shot::is_made(frame));
    if frames.is_empty() && report.failed.is_empty() {
        return Ok(None);
    }
    let all = frames.len();
    let shown = evenly(all, SHOWN);
    let figures = shown.iter().map(|k| figure(&frames[*k]));
    let mut words = match all == shown.len() {
        true => format!("{all} made"),
        false => format!("{all} made, of which {} are shown", shown.len()),
    };
    if !report.failed.is_empty() {
        words += &format!(
            "; {} failed: {}",
            report.failed.len(),
            report.failed.join(", ")
        );
    }
    words += match all {
        0 => ".",
        _ => ". Each name leads to the frame's picture.",
    };
    Ok(Some(Html::all([
        Html::element("div", &[("class", "grid-of small")], figures),
        Html::element("p", &[("class", "soft")], [Html::text(words)]),
    ])))
}

/// At most `most` of the numbers below `all`, the first and the last among them.
fn evenly(all: usize, most: usize) -> Vec<usize> {
    match all <= most {
        true => (0..all).collect(),
        false => (0..most).map(|k| k * (all - 1) / (most - 1)).collect(),
    }
}

/// A frame's picture under its name and the time that it took, or why it is not shown.
fn figure(frame: &Path) -> Html {
    let name = frame.file_name().unwrap_or_default().to_string_lossy();
    let times = [SCENE.name, COMPOSITE.name].map(|stage| {
        let manifest = Manifest::read(&frame.join(stage), "");
        manifest.map_or(0.0, |m| m.elapsed_s)
    });
    let picture = picture(frame).and_then(|(file, picture)| {
        let address = [shot::FOLDER, &name, COMPOSITE.name, &file].map(encoded);
        let address = address.join("/");
        let link = Html::element("a", &[("href", &address)], [Html::text(&name)]);
        Ok((link, image(&picture, SMALL, &name)?))
    });
    let (link, shown) = picture.unwrap_or_else(|e| {
        let why = Html::text(format!("Not shown: {}", dipir_cli::exit::describe(&e)));
        let why = Html::element("p", &[("class", "soft")], [why]);
        (Html::text(&name), why)
    });
    let time = Html::text(format!(" {}", duration(times.iter().sum())));
    let caption = Html::element("figcaption", &[], [link, time]);
    Html::element("figure", &[], [caption, shown])
}

/// The name and the pixels of a frame's picture, as they are stored.
fn picture(frame: &Path) -> anyhow::Result<(String, DisplayImage)> {
    let folder = frame.join(COMPOSITE.name);
    let path = Manifest::read(&folder, "")?.output(&folder, "picture")?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let pixels = decode_texture(&std::fs::read(&path)?, &path.display().to_string())?;
    let colour = |p: &[u8; 4]| Vec3::from([p[0], p[1], p[2]].map(f32::from)) / 255.0;
    Ok((name.into_owned(), DisplayImage(pixels.map(colour))))
}

/// A part of a path as a part of an address.
fn encoded(part: &str) -> String {
    let plain = |b: u8| b.is_ascii_alphanumeric() || b"-._~".contains(&b);
    let bytes = part.bytes().map(|b| match plain(b) {
        true => char::from(b).to_string(),
        false => format!("%{b:02X}"),
    });
    bytes.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_and_last_are_among_those_that_are_shown() {
        assert_eq!(evenly(3, 24), [0, 1, 2]);
        assert_eq!(evenly(0, 24), [0; 0]);
        let some = evenly(1000, 24);
        assert_eq!((some.len(), some[0], some[23]), (24, 0, 999));
        assert!(some.windows(2).all(|w| w[0] < w[1]));
    }

    #[test]
    fn names_are_parts_of_addresses() {
        assert_eq!(encoded("shot_0001.a-b~c"), "shot_0001.a-b~c");
        assert_eq!(encoded("a b#?%/ü"), "a%20b%23%3F%25%2F%C3%BC");
    }
}
