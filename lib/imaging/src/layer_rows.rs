//! Layers that are computed row by row while they are written, so that none of them is held in memory.
use crate::{
    error::{ImagingError, MAX_PIXELS},
    exr_file,
    layers::{Layers, Precision, check_name},
    primaries::{Primaries, REC709},
    raster::Raster,
};
use rayon::prelude::*;
use std::{collections::BTreeMap, path::Path};

/// Fills a slice with the samples of a row.
type FillRow<'a> = Box<dyn Fn(usize, &mut [f32]) + Sync + 'a>;

/// Where the samples of a channel come from, and how a file stores them.
pub(crate) struct RowChannel<'a> {
    pub precision: Precision,
    pub fill: FillRow<'a>,
}

/// How a file is compressed, without loss in either case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Packing {
    /// ZIP1: small files.
    #[default]
    Small,
    /// Run lengths: files up to twice as large, in a fraction of the time.
    Quick,
}

/// Named channels of one size, as [`Layers`], whose samples are asked for when the file is written. A file holds the
/// same bytes as that of [`Layers`] with the same samples.
pub struct LayerRows<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) channels: BTreeMap<String, RowChannel<'a>>,
    pub(crate) latlong: bool,
    pub(crate) packing: Packing,
    /// Those of the colours, if there are any.
    pub(crate) primaries: Option<Primaries>,
}

impl<'a> LayerRows<'a> {
    /// No channels yet, `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            channels: BTreeMap::new(),
            latlong: false,
            packing: Packing::default(),
            primaries: None,
        }
    }

    /// Compressed as `packing` says.
    pub fn packed(self, packing: Packing) -> Self {
        Self { packing, ..self }
    }

    /// The channels of `layers`.
    pub(crate) fn of(layers: &'a Layers) -> Self {
        let mut rows = Self::new(layers.width(), layers.height());
        rows.latlong = layers.latlong;
        rows.primaries = layers.primaries;
        for (name, channel) in layers.channels() {
            rows.add(name.to_owned(), channel.precision, &channel.samples);
        }
        rows
    }

    fn add(&mut self, name: String, precision: Precision, samples: &'a Raster<f32>) {
        let fill: FillRow<'a> = Box::new(move |y, row| row.copy_from_slice(samples.row(y)));
        self.channels.insert(name, RowChannel { precision, fill });
    }

    /// Adds the channel `name`, or replaces it. Errors if the size differs or the name is one that
    /// compositing programs do not take (empty, only digits, over 255 bytes).
    pub fn insert(
        &mut self,
        name: &str,
        precision: Precision,
        samples: &'a Raster<f32>,
    ) -> Result<(), ImagingError> {
        check_name(name)?;
        if (samples.width(), samples.height()) != (self.width, self.height) {
            return Err(ImagingError::SizeMismatch {
                what: format!("channel `{name}`"),
                found: (samples.width(), samples.height()),
                expected: (self.width, self.height),
                reference: "the other layers",
            });
        }
        self.add(name.to_owned(), precision, samples);
        Ok(())
    }

    /// Adds the channels `names`, the components of what `pixel` gives for a pixel's index, row by row from the top
    /// left. `R`, `G`, `B`, bare or of a layer, are colour, of which the file says that it is linear Rec.709 (the
    /// `chromaticities` attribute). Errors as [`insert`](Self::insert).
    pub fn insert_pixels<P: Into<[f32; N]>, const N: usize>(
        &mut self,
        names: [&str; N],
        precision: Precision,
        pixel: impl Fn(usize) -> P + Copy + Sync + 'a,
    ) -> Result<(), ImagingError> {
        let suffixes = names.map(|name| name.rsplit('.').next().unwrap_or(name));
        if suffixes[..] == ["R", "G", "B"] {
            self.primaries = Some(REC709);
        }
        let width = self.width;
        for (k, name) in names.into_iter().enumerate() {
            check_name(name)?;
            let fill: FillRow<'a> = Box::new(move |y, row| {
                for (x, sample) in row.iter_mut().enumerate() {
                    *sample = pixel(y * width + x).into()[k];
                }
            });
            let channel = RowChannel { precision, fill };
            self.channels.insert(name.to_owned(), channel);
        }
        Ok(())
    }

    /// Adds a channel of one value.
    pub fn insert_constant(
        &mut self,
        name: &str,
        precision: Precision,
        value: f32,
    ) -> Result<(), ImagingError> {
        check_name(name)?;
        let fill: FillRow<'a> = Box::new(move |_, row| row.fill(value));
        self.channels
            .insert(name.to_owned(), RowChannel { precision, fill });
        Ok(())
    }

    /// Writes an OpenEXR file: one part, scan lines. Replaces an existing file.
    pub fn write_exr(mut self, path: impl AsRef<Path>) -> Result<(), ImagingError> {
        let path = path.as_ref();
        let (width, height) = (self.width, self.height);
        if width == 0 || height == 0 || width.saturating_mul(height) > MAX_PIXELS {
            return Err(ImagingError::BadSize {
                what: format!("the image for `{}`", path.display()),
                width,
                height,
            });
        }
        for channel in self.channels.values_mut() {
            if channel.precision == Precision::Half {
                channel.precision = fitting(&channel.fill, width, height);
            }
        }
        exr_file::write(&self, path)
    }
}

/// Half, unless a finite value would overflow to infinity.
fn fitting(fill: &FillRow, width: usize, height: usize) -> Precision {
    let overflows = (0..height).into_par_iter().any(|y| {
        let mut row = vec![0.0; width];
        fill(y, &mut row);
        Precision::half_if_it_fits(row) == Precision::Full
    });
    match overflows {
        true => Precision::Full,
        false => Precision::Half,
    }
}
