//! What the photograph's camera did to the photograph, done to object and shadow, too: blur and grain.
use std::borrow::Cow;
use std::ops::Range;

use dipir_imaging::composite::composite_pixel;
use dipir_imaging::file::Photo;
use dipir_imaging::grain::Grain;
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::resize::PixelBox;
use dipir_imaging::sharpness::{self, edge_blur_px};
use dipir_imaging::transfer::Transfer;
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::table::CompositeTable;
use crate::light::exposed;

/// Less blur than this is not added, pixels: an edge differs by more with where it crosses the pixels.
const LEAST_BLUR_PX: f32 = 0.5;
/// Most blur, pixels: a photograph whose sharpest edges are softer is out of focus as a whole.
const MOST_BLUR_PX: f32 = 6.0;

/// How the photograph looks beside a rendered picture.
pub(super) struct Look {
    looks_for_blur: bool,
    blurs: Blurs,
    edge_blur_px: Option<f32>,
    grain: Option<Grain>,
    shown: Shown,
}

/// What was done, the content of `look.json`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Matched {
    /// Standard deviation of the blur of the photograph's sharpest edges, pixels: .4 or less where there is none, 6 at most;
    /// absent where it was not looked for, and where nothing tells it.
    pub edge_blur_px: Option<f32>,
    /// Standard deviation of the blur of object and shadow, pixels; absent if they were not blurred.
    pub blur_px: Option<f32>,
    /// Standard deviation of the grain on the object where it is mid-grey, of each channel, display values; absent if it got none.
    pub grain: Option<[f32; 3]>,
    /// Least and greatest radius of the discs that points of the objects are seen as, pixels; absent if it is not known what is
    /// in focus.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub out_of_focus_px: Option<[f32; 2]>,
    /// Least and greatest length of the lines that points of the objects are seen as, pixels; absent if it is not known how long
    /// the shutter was open.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moving_px: Option<[f32; 2]>,
}

/// How wide points of the objects are seen, as [`Matched`] has it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Blurs {
    pub out_of_focus_px: Option<[f32; 2]>,
    pub moving_px: Option<[f32; 2]>,
}

/// From light to display values and back.
#[derive(Clone, Copy)]
struct Shown {
    transfer: Transfer,
    gain: f32,
}

impl Shown {
    fn display(self, light: Vec3) -> Vec3 {
        let values = (light * self.gain).to_array();
        Vec3::from_array(values.map(|v| self.transfer.encode_scalar(v)))
    }

    /// `light` with `grain` added to its display values. Light that shows black or white stays.
    fn with_grain(self, light: Vec3, display: Vec3, grain: Vec3) -> Vec3 {
        Vec3::from_array(
            [0, 1, 2].map(|c| match display[c] > 0.0 && display[c] < 1.0 {
                true => self.transfer.decode_scalar(display[c] + grain[c]) / self.gain,
                false => light[c],
            }),
        )
    }
}

/// The layers that are laid over the photograph, of its size.
pub(super) struct Overlay {
    pub object: Raster<Vec3>,
    pub alpha: Raster<f32>,
    pub shadow: Raster<Vec3>,
}

/// Blur of edges that are rendered at one over `divisor` of the resolution, pixels. Enlarged, an edge is blurred by a box of
/// `divisor` pixels and a tent of twice that: their standard deviation is half of `divisor`.
fn own_blur_px(divisor: u32) -> f32 {
    match divisor {
        1 => sharpness::OF_PIXELS,
        _ => 0.5 * divisor as f32,
    }
}

impl Look {
    /// Looks at the photograph as it was taken; `table` says for what. `blurs` is what blurs the objects beside it.
    pub fn of(taken: &Photo, blurs: Blurs, table: &CompositeTable) -> Self {
        let shown = Shown {
            transfer: taken.transfer,
            gain: exposed::gain(taken, &taken.image),
        };
        let grain = || Grain::of(&taken.image, |light| shown.display(light));
        let looks_for_blur = table.matches_blur();
        Self {
            looks_for_blur,
            blurs,
            edge_blur_px: looks_for_blur
                .then(|| edge_blur_px(&taken.image, shown.gain.recip()))
                .flatten()
                .map(|px| px.min(MOST_BLUR_PX)),
            grain: table.matches_grain().then(grain).flatten(),
            shown,
        }
    }

    /// Blurs the layers, and puts grain on the object. `hidden` is what stands in front; the layers were
    /// rendered at one over `divisor` of the photograph's resolution.
    pub fn apply(
        &self,
        layers: &mut Overlay,
        background: &LinearImage,
        hidden: Option<&Hidden>,
        divisor: u32,
    ) -> Matched {
        let blur_px = self.blur_px(divisor);
        if let Some(blur_px) = blur_px {
            layers.blur(hidden, blur_px, self.shown.gain.recip());
        }
        if let Some(grain) = &self.grain {
            self.add_grain(layers, background, grain);
        }
        let grain = self.grain.as_ref();
        Matched {
            edge_blur_px: self.edge_blur_px,
            blur_px,
            grain: grain.map(|g| g.deviation(Vec3::splat(0.5)).to_array()),
            out_of_focus_px: self.blurs.out_of_focus_px,
            moving_px: self.blurs.moving_px,
        }
    }

    /// Pixels of a picture of `resolution` that are as sharp as the photograph: those of the whole one, a quarter of them, and
    /// so on. `None` where it is not known how sharp it is.
    pub fn enough_pixels(&self, resolution: [u32; 2]) -> Option<u64> {
        let blur_px = self.edge_blur_px?;
        let divisor = [4, 2].into_iter().find(|&d| own_blur_px(d) <= blur_px);
        let [width, height] = resolution.map(|n| u64::from(n.div_ceil(divisor.unwrap_or(1))));
        Some(width * height)
    }

    /// Whether the photograph's blur was looked for and nothing tells it.
    pub fn is_blur_unknown(&self) -> bool {
        self.looks_for_blur && self.edge_blur_px.is_none()
    }

    /// Blur that layers which were rendered at one over `divisor` of the resolution lack.
    fn blur_px(&self, divisor: u32) -> Option<f32> {
        let own = own_blur_px(divisor);
        let wanted = self.edge_blur_px?;
        let lacks = (wanted * wanted - own * own).max(0.0).sqrt();
        (lacks >= LEAST_BLUR_PX).then_some(lacks)
    }

    fn add_grain(&self, layers: &mut Overlay, background: &LinearImage, grain: &Grain) {
        let width = layers.alpha.width();
        let (alpha, shadow) = (layers.alpha.pixels(), layers.shadow.pixels());
        let background = background.0.pixels();
        let object = layers.object.pixels_mut().par_iter_mut().enumerate();
        object.for_each(|(i, object)| {
            if alpha[i] == 0.0 {
                return;
            }
            let light = composite_pixel(background[i], *object, alpha[i], shadow[i]);
            let display = self.shown.display(light);
            let grain = grain.at(i % width, i / width, display) * alpha[i];
            *object += self.shown.with_grain(light, display, grain) - light;
        });
    }
}

/// Masks of what stands in front of the layers, of their size.
pub struct Hidden<'a> {
    /// Hides the object.
    pub object: Cow<'a, Raster<f32>>,
    /// Hides the shadow.
    pub shadow: Cow<'a, Raster<f32>>,
}

impl Overlay {
    /// Blurs all layers where they change the photograph. Light above `white` stays where it is: a glint of a pixel would
    /// become a disc, and so would its noise, which nobody sees beyond white.
    fn blur(&mut self, hidden: Option<&Hidden>, blur_px: f32, white: f32) {
        let Some(part) = self.touched(2 + (3.0 * blur_px) as usize) else {
            return;
        };
        let seen = |mask: &Raster<f32>| mask.map(|m| 1.0 - m.clamp(0.0, 1.0));
        let of_object = hidden.map(|hidden| seen(&hidden.object));
        let white = Vec3::splat(white);
        let width = self.alpha.width();
        let rows = (part.y..part.y + part.height).map(|y| y * width + part.x);
        let inside: Vec<Range<usize>> = rows.map(|start| start..start + part.width).collect();
        let mut beyond_white = Vec::with_capacity(part.width * part.height);
        for row in &inside {
            for light in &mut self.object.pixels_mut()[row.clone()] {
                beyond_white.push((*light - white).max(Vec3::ZERO));
                *light = light.min(white);
            }
        }
        sharpness::blur(&mut self.object, of_object.as_ref(), part, blur_px);
        let object = self.object.pixels_mut();
        for (i, beyond) in inside.into_iter().flatten().zip(beyond_white) {
            object[i] += beyond;
        }
        sharpness::blur(&mut self.alpha, of_object.as_ref(), part, blur_px);
        drop(of_object);
        let of_shadow = hidden.map(|hidden| seen(&hidden.shadow));
        // Where there is no shadow, nothing of the light is missing.
        self.shadow.pixels_mut().iter_mut().for_each(|s| *s -= 1.0);
        sharpness::blur(&mut self.shadow, of_shadow.as_ref(), part, blur_px);
        self.shadow.pixels_mut().iter_mut().for_each(|s| *s += 1.0);
    }

    /// The pixels with something in them, and `margin` more to all sides.
    fn touched(&self, margin: usize) -> Option<PixelBox> {
        let (width, height) = (self.alpha.width(), self.alpha.height());
        // Polished ground adds light where the object covers nothing.
        let is_touched = |i: usize| {
            self.alpha.pixels()[i] > 0.0
                || self.shadow.pixels()[i] != Vec3::ONE
                || self.object.pixels()[i] != Vec3::ZERO
        };
        let (mut left, mut right, mut top, mut bottom) = (width, 0, height, 0);
        for i in (0..width * height).filter(|&i| is_touched(i)) {
            let (x, y) = (i % width, i / width);
            (left, right) = (left.min(x), right.max(x + 1));
            (top, bottom) = (top.min(y), bottom.max(y + 1));
        }
        if left >= right {
            return None;
        }
        let (x, y) = (left.saturating_sub(margin), top.saturating_sub(margin));
        Some(PixelBox {
            x,
            y,
            width: (right + margin).min(width) - x,
            height: (bottom + margin).min(height) - y,
        })
    }
}

impl Matched {
    /// What was done, as the end of a sentence on the object; `None` if nothing was.
    pub fn text(&self) -> Option<String> {
        let blur = self.blur_px.map(|px| format!("blurred by {px:.1} pixels"));
        let grain = self.grain.map(|g| {
            let percent = 100.0 * g.iter().sum::<f32>() / 3.0;
            format!("grainy by {percent:.1}% of white")
        });
        let done: Vec<String> = [blur, grain].into_iter().flatten().collect();
        (!done.is_empty()).then(|| format!("{} as the photograph is", done.join(" and ")))
    }
}

impl Matched {
    /// How wide points of the objects are seen, as sentences with what each is of; none where nothing says what is in focus or how
    /// long the shutter was open.
    pub fn blurs_texts(&self) -> Vec<[String; 2]> {
        let focus = self.out_of_focus_px.map(|radii| {
            let [least, most] = radii.map(|radius| 2.0 * radius);
            let text = match most < 1.0 {
                true => "the objects are in focus".into(),
                false => format!("out of focus, points of the objects are discs of {least:.0} to {most:.0} pixels"),
            };
            ["Depth of field".into(), text]
        });
        let moving = self.moving_px.map(|[least, most]| {
            let text = match most < 0.5 {
                true => "the camera hardly moves past the objects".into(),
                false => format!("points of the objects are lines of {least:.0} to {most:.0} pixels, as the camera moves"),
            };
            ["Motion blur".into(), text]
        });
        focus.into_iter().chain(moving).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An object of `light` in the left half of 40 x 20 pixels, and no shadow.
    fn half(light: f32) -> Overlay {
        let alpha = Raster::from_pixels(
            40,
            20,
            (0..800).map(|i| f32::from(u8::from(i % 40 < 20))).collect(),
        );
        Overlay {
            object: alpha.map(|a| Vec3::splat(light * a)),
            alpha,
            shadow: Raster::filled(40, 20, Vec3::ONE),
        }
    }

    #[test]
    fn a_glint_stays_a_pixel_and_what_is_far_from_edges_stays() {
        let mut layers = half(0.5);
        *layers.object.get_mut(8, 10) = Vec3::splat(1e6);
        layers.blur(None, 1.0, 1.0);
        // White spreads by at most the middle weight of a Gaussian of one pixel in two directions, .16.
        let beside = layers.object.get(9, 10).x;
        assert!(beside > 0.5 && beside < 0.66, "{beside}");
        assert!(layers.object.get(8, 10).x > 0.99e6);
        assert_eq!(*layers.shadow.get(20, 10), Vec3::ONE);
        // Beyond the reach of the edge and of the glint, four deviations; weights sum to 1 but for rounding.
        let far = layers.object.get(14, 10).x;
        assert!((far - 0.5).abs() < 1e-6, "{far}");
        // The edge lies between two pixels, so they share what it loses.
        let [inner, outer] = [19, 20].map(|x| layers.alpha.get(x, 10));
        assert!(
            (inner + outer - 1.0).abs() < 1e-6 && *outer > 0.2,
            "{inner} {outer}"
        );
    }

    #[test]
    fn light_that_is_infinite_is_still_found_after_blur() {
        let mut layers = half(0.5);
        *layers.object.get_mut(8, 10) = Vec3::INFINITY;
        layers.blur(None, 1.0, 1.0);
        assert!(!layers.object.get(8, 10).is_finite());
        assert!(layers.object.get(9, 10).is_finite());
    }

    #[test]
    fn layers_that_show_nothing_stay() {
        let mut layers = half(0.5);
        layers.alpha = Raster::filled(40, 20, 0.0);
        assert!(layers.touched(3).is_some(), "added light");
        layers.object = Raster::filled(40, 20, Vec3::ZERO);
        assert_eq!(layers.touched(3), None);
    }
}
