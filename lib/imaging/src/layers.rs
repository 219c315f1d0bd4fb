//! Images of named channels, as compositing programs exchange them: OpenEXR files.
use crate::{
    error::ImagingError,
    exr_file,
    layer_rows::LayerRows,
    primaries::{Primaries, REC709},
    raster::Raster,
};
use glam::Vec3;
use half::f16;
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// How a channel's samples are stored in a file. In memory they are always f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 16-bit float: 11 significant bits, largest value 65504. A channel that holds a larger
    /// finite value is stored in full instead, so that no light is lost.
    Half,
    /// 32-bit float.
    Full,
}

impl Precision {
    /// Half, unless one of the values is finite and beyond what half can hold: then it would turn
    /// into infinity.
    pub fn half_if_it_fits(values: impl IntoIterator<Item = f32>) -> Self {
        let limit = f16::MAX.to_f32();
        let mut values = values.into_iter();
        match values.any(|v| v.is_finite() && v.abs() > limit) {
            true => Self::Full,
            false => Self::Half,
        }
    }

    /// [`half_if_it_fits`](Self::half_if_it_fits) for all three colours of a layer together.
    pub fn of_colour(colour: &Raster<Vec3>) -> Self {
        Self::half_if_it_fits(colour.pixels().iter().flat_map(|p| p.to_array()))
    }

    /// The value as a file stores it.
    #[inline]
    pub fn round(self, value: f32) -> f32 {
        match self {
            Self::Half => f16::from_f32(value).to_f32(),
            Self::Full => value,
        }
    }

    /// [`round`](Self::round) of a colour.
    #[inline]
    pub fn round_colour(self, colour: Vec3) -> Vec3 {
        Vec3::from_array(colour.to_array().map(|v| self.round(v)))
    }
}

/// Samples of one channel, and how a file stores them.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// How the file stores the samples.
    pub precision: Precision,
    /// One value a pixel.
    pub samples: Raster<f32>,
}

/// Named channels of one size: `R`, `shadow.G`, `depth.Z`. The part before the last dot is the
/// layer. Files are OpenEXR, scan lines, ZIP1.
#[derive(Clone, Debug)]
pub struct Layers {
    width: usize,
    height: usize,
    channels: BTreeMap<String, Channel>,
    /// Whether the image is a latitude-longitude environment map (the `envmap` attribute).
    pub latlong: bool,
    attributes: BTreeMap<String, String>,
    path: Option<PathBuf>,
    /// Those of the colours in the file (the `chromaticities` attribute).
    pub(crate) primaries: Option<Primaries>,
    /// How many times as wide as high the file's pixels are.
    pub(crate) pixel_aspect: f32,
    /// Columns and rows of a data window of the file of which pixels outside the display window were dropped.
    pub(crate) overscan: Option<(usize, usize)>,
    /// Channels of the file that were not asked for, or whose name [`check_name`] refuses.
    skipped: Vec<String>,
}

impl Layers {
    /// No channels yet, `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            channels: BTreeMap::new(),
            latlong: false,
            attributes: BTreeMap::new(),
            path: None,
            primaries: None,
            pixel_aspect: 1.0,
            overscan: None,
            skipped: Vec::new(),
        }
    }

    pub(crate) fn from_file(width: usize, height: usize, path: &Path) -> Self {
        Self {
            path: Some(path.to_owned()),
            ..Self::new(width, height)
        }
    }

    pub(crate) fn note_skipped(&mut self, name: String) {
        self.skipped.push(name);
    }

    pub(crate) fn keep_attribute(&mut self, name: String, value: String) {
        self.attributes.insert(name, value);
    }

    /// All text attributes of the file, in alphabetical order. They are not written.
    pub fn attributes(&self) -> impl Iterator<Item = (&str, &str)> {
        self.attributes
            .iter()
            .map(|(n, v)| (n.as_str(), v.as_str()))
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Channel names in alphabetical order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.channels.keys().map(String::as_str)
    }

    /// All channels with their names, in alphabetical order.
    pub fn channels(&self) -> impl Iterator<Item = (&str, &Channel)> {
        self.channels.iter().map(|(name, c)| (name.as_str(), c))
    }

    /// Adds the channel `name`, or replaces it. Errors if the size differs or the name is one that
    /// compositing programs do not take (empty, only digits, over 255 bytes).
    pub fn insert(
        &mut self,
        name: impl Into<String>,
        precision: Precision,
        samples: Raster<f32>,
    ) -> Result<(), ImagingError> {
        let name = name.into();
        check_name(&name)?;
        if (samples.width(), samples.height()) != (self.width, self.height) {
            return Err(ImagingError::SizeMismatch {
                what: format!("channel `{name}`"),
                found: (samples.width(), samples.height()),
                expected: (self.width, self.height),
                reference: "the other layers",
            });
        }
        self.channels.insert(name, Channel { precision, samples });
        Ok(())
    }

    /// Adds colour as `R`, `G`, `B` of `layer`; bare names if `layer` is empty. A file says that it is linear
    /// Rec.709 (the `chromaticities` attribute), unless these layers are those of a file of other primaries.
    pub fn insert_rgb(
        &mut self,
        layer: &str,
        precision: Precision,
        colour: &Raster<Vec3>,
    ) -> Result<(), ImagingError> {
        self.primaries.get_or_insert(REC709);
        self.insert_triple(layer, ["R", "G", "B"], precision, colour)
    }

    /// Adds vectors as `X`, `Y`, `Z` of `layer`.
    pub fn insert_xyz(
        &mut self,
        layer: &str,
        precision: Precision,
        vectors: &Raster<Vec3>,
    ) -> Result<(), ImagingError> {
        self.insert_triple(layer, ["X", "Y", "Z"], precision, vectors)
    }

    fn insert_triple(
        &mut self,
        layer: &str,
        suffixes: [&str; 3],
        precision: Precision,
        values: &Raster<Vec3>,
    ) -> Result<(), ImagingError> {
        for (i, suffix) in suffixes.into_iter().enumerate() {
            self.insert(channel_name(layer, suffix), precision, values.map(|v| v[i]))?;
        }
        Ok(())
    }

    /// Whether the channel exists.
    pub fn contains(&self, name: &str) -> bool {
        self.channels.contains_key(name)
    }

    /// Samples of the channel `name`; the error lists the channels that exist.
    pub fn channel(&self, name: &str) -> Result<&Raster<f32>, ImagingError> {
        match self.channels.get(name) {
            Some(channel) => Ok(&channel.samples),
            None => Err(self.missing(name)),
        }
    }

    /// `R`, `G`, `B` of `layer` as colour; bare names if `layer` is empty.
    pub fn rgb(&self, layer: &str) -> Result<Raster<Vec3>, ImagingError> {
        self.triple(layer, ["R", "G", "B"])
    }

    /// `X`, `Y`, `Z` of `layer` as vectors.
    pub fn xyz(&self, layer: &str) -> Result<Raster<Vec3>, ImagingError> {
        self.triple(layer, ["X", "Y", "Z"])
    }

    fn triple(&self, layer: &str, suffixes: [&str; 3]) -> Result<Raster<Vec3>, ImagingError> {
        let x = self.channel(&channel_name(layer, suffixes[0]))?.pixels();
        let y = self.channel(&channel_name(layer, suffixes[1]))?.pixels();
        let z = self.channel(&channel_name(layer, suffixes[2]))?.pixels();
        let pixels = (0..x.len()).map(|i| Vec3::new(x[i], y[i], z[i])).collect();
        Ok(Raster::from_pixels(self.width, self.height, pixels))
    }

    /// Channels of the file that were not asked for, or whose name is refused.
    pub(crate) fn skipped(&self) -> &[String] {
        &self.skipped
    }

    fn missing(&self, name: &str) -> ImagingError {
        let present = self.channels.keys().chain(&self.skipped);
        ImagingError::MissingChannel {
            path: self.path.clone(),
            channel: name.to_string(),
            present: present.cloned().collect(),
        }
    }

    /// Writes an OpenEXR file: one part, scan lines, ZIP1. Replaces an existing file.
    pub fn write_exr(&self, path: impl AsRef<Path>) -> Result<(), ImagingError> {
        LayerRows::of(self).write_exr(path)
    }

    /// Reads all channels of an OpenEXR file.
    ///
    /// The result has the size of the display window: pixels outside the data window are 0, those
    /// outside the display window are dropped. Channels of a further part whose name is taken
    /// already get the part's name in front. Channels whose name this type refuses, as one with a
    /// space, are left out. Values are not checked for NaN or infinity: depth may be infinite.
    /// Colours are those of the file, in the primaries that it names.
    pub fn read_exr(path: impl AsRef<Path>) -> Result<Self, ImagingError> {
        exr_file::open(path.as_ref(), None)
    }

    /// As [`read_exr`](Self::read_exr), to look at: square blocks of pixels become one with the mean of their finite
    /// values, so that the longer side has `longest` pixels at least and less than twice as many. Nothing of the file's size
    /// is kept. A large file whose data window is not its display window is refused.
    pub fn read_exr_small(path: impl AsRef<Path>, longest: usize) -> Result<Self, ImagingError> {
        exr_file::open(path.as_ref(), Some(longest))
    }
}

/// `layer.suffix`, or the bare suffix for the beauty layer.
fn channel_name(layer: &str, suffix: &str) -> String {
    if layer.is_empty() {
        suffix.to_string()
    } else {
        format!("{layer}.{suffix}")
    }
}

pub(crate) fn check_name(name: &str) -> Result<(), ImagingError> {
    let reason = if name.is_empty() {
        "is empty"
    } else if name.len() > 255 {
        "is longer than 255 bytes"
    } else if !name.bytes().all(|b| b.is_ascii_graphic()) {
        "has characters other than printable ASCII"
    } else if name.split('.').any(str::is_empty) {
        "has an empty part"
    } else if name.bytes().all(|b| b.is_ascii_digit()) {
        "is only digits"
    } else {
        return Ok(());
    };
    Err(ImagingError::BadChannelName {
        name: name.to_string(),
        reason,
    })
}

/// Equal size, channels, precision and attributes, wherever they came from.
impl PartialEq for Layers {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height, self.latlong) == (other.width, other.height, other.latlong)
            && self.channels == other.channels
            && self.attributes == other.attributes
    }
}
