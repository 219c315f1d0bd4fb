//! The gain map of a JPEG photograph: how much brighter than the picture shows it each part was. It is a second JPEG behind
//! the first [Android, Ultra HDR image format 1.1], whose XMP or binary metadata [ISO 21496-1] say what its values mean.
use crate::{
    decode::{Decoded, SizeLimit},
    file::Photo,
    gain_metadata::{self, Channel},
    jpeg_header,
    raster::{LinearImage, Raster},
};
use glam::Vec3;
use rayon::prelude::*;
use std::{borrow::Cow, path::Path};

/// The shapes of a picture and its gain map differ by at most this share.
const MOST_ASKEW: f64 = 0.1;
/// Pictures behind the first that are looked at. A gain map comes before depth, movies and what else cameras append.
const MOST_TRIES: usize = 32;

/// A gain map with what its values mean.
#[derive(Clone, Debug, PartialEq)]
pub struct GainMap {
    /// As stored, of the upright picture, mostly smaller.
    values: Raster<[u8; 3]>,
    channels: [Channel; 3],
}

impl GainMap {
    /// The gain map behind the picture that was decoded from `bytes`; `None` where the file announces none.
    ///
    /// # Errors
    /// With what is wrong with it, in words.
    pub(crate) fn of(
        bytes: &[u8],
        decoded: &Decoded,
        limit: SizeLimit,
    ) -> Option<Result<Self, String>> {
        gain_metadata::is_announced(bytes).then(|| Self::behind(bytes, decoded, limit))
    }

    fn behind(bytes: &[u8], decoded: &Decoded, limit: SizeLimit) -> Result<Self, String> {
        let name = Path::new("gain map");
        let end = jpeg_header::check(bytes, name).map_err(|e| e.to_string())?;
        let behind = &bytes[end..];
        let starts = behind.windows(3).enumerate();
        let starts = starts.filter(|(_, window)| *window == [0xff, 0xd8, 0xff]);
        let mut found = starts
            .take(MOST_TRIES)
            .filter_map(|(at, _)| Some((at, gain_metadata::of(&behind[at..])?)));
        let (at, metadata) = found
            .next()
            .ok_or("the file announces it and does not hold it")?;
        let channels = metadata?;
        let picture = Decoded::of(&behind[at..], name, "a JPEG image", limit)
            .map_err(|e| e.to_string())?
            .turned_as(decoded);
        let (own, other) = (picture.upright_size(), decoded.upright_size());
        let shape = |(width, height): (usize, usize)| width as f64 / height as f64;
        if (shape(own) / shape(other)).ln().abs() > MOST_ASKEW {
            return Err(format!(
                "it has {} x {} pixels, the picture {} x {}: another shape",
                own.0, own.1, other.0, other.1
            ));
        }
        Ok(Self {
            values: picture.values_8(),
            channels,
        })
    }

    /// The brightest light that white has with the map: what is as bright may be brighter still.
    pub fn most(&self) -> f32 {
        let most = |c: &Channel| c.brighter(1.0, c.factor(1.0));
        self.channels.iter().map(most).fold(1.0, f32::max)
    }

    /// The linear light of a picture of the photograph, of any size, with the gain where it is above 1. White is 1 as before.
    fn brightened(&self, image: &LinearImage) -> LinearImage {
        let (width, height) = (image.0.width(), image.0.height());
        let same = self.channels[1..].iter().all(|c| *c == self.channels[0]);
        let pixels = image.0.pixels().par_iter().enumerate().map(|(i, light)| {
            let stored = self.sample(
                ((i % width) as f32 + 0.5) / width as f32,
                ((i / width) as f32 + 0.5) / height as f32,
            );
            let one = same && stored[0] == stored[1] && stored[1] == stored[2];
            let factor = |k: usize| self.channels[k].factor(stored[k]);
            let factors = match one {
                true => [factor(0); 3],
                false => [0, 1, 2].map(factor),
            };
            let channel = |k: usize| self.channels[k].brighter(light[k], factors[k]);
            Vec3::from_array([0, 1, 2].map(channel))
        });
        LinearImage(Raster::from_pixels(width, height, pixels.collect()))
    }

    /// The values in `[0, 1]` at a place in the upright picture, shares of its width and height; bilinear.
    fn sample(&self, u: f32, v: f32) -> [f32; 3] {
        let along = |share: f32, count: usize| {
            let at = (share * count as f32 - 0.5).clamp(0.0, (count - 1) as f32);
            (
                at as usize,
                (at as usize + 1).min(count - 1),
                at - at.floor(),
            )
        };
        let (left, right, x) = along(u, self.values.width());
        let (above, below, y) = along(v, self.values.height());
        let texel = |column: usize, row: usize| {
            let [r, g, b] = *self.values.get(column, row);
            Vec3::new(f32::from(r), f32::from(g), f32::from(b)) / 255.0
        };
        let row = |row: usize| texel(left, row).lerp(texel(right, row), x);
        row(above).lerp(row(below), y).to_array()
    }
}

impl Photo {
    /// The photograph's light with its gain map: values above 1 where the picture is white and the place was brighter. The
    /// picture itself where there is none.
    ///
    /// Channels of the gain are applied in Rec.709, whatever the file's primaries are: to a map of one channel it is the same.
    pub fn radiance(&self) -> Cow<'_, LinearImage> {
        match &self.gain {
            Some(gain) => Cow::Owned(gain.brightened(&self.image)),
            None => Cow::Borrowed(&self.image),
        }
    }
}

/// A warning about a gain map that cannot be used.
pub(crate) fn unusable(why: &str, path: &Path) -> String {
    format!(
        "`{}`: its gain map cannot be used ({why}); the picture is read without it, and what it shows as white is no brighter",
        path.display()
    )
}

#[cfg(test)]
mod tests;
