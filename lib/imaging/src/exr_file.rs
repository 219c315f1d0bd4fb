//! OpenEXR files in and out, between the `exr` library and [`Layers`].
use crate::{
    decode::SizeLimit,
    error::ImagingError,
    format::Format,
    layers::{Layers, Precision},
    raster::Raster,
};
use exr::{
    block::{chunk::TileCoordinates, lines::LineRef},
    image::{
        read::{
            any_channels::{ReadAnyChannels, ReadSamples, SamplesReader},
            layers::ReadChannels,
        },
        write::WritableImage,
    },
    math::Vec2,
    meta::{
        attribute::{AttributeValue, ChannelDescription, EnvironmentMap, SampleType, Text},
        header::{Header, LayerAttributes},
    },
    prelude::{
        AnyChannel, AnyChannels, Compression, Encoding, FlatSamples, Image, Layer, ReadLayers,
        SmallVec,
    },
};
use half::{f16, slice::HalfFloatSliceExt};
use rayon::prelude::*;
use std::{
    cell::Cell,
    fs::File,
    io::{BufRead, BufReader, BufWriter, Read, Seek, Write},
    path::{Path, PathBuf},
    rc::Rc,
};

/// The name of the format in messages.
const FORMAT: &str = "OpenEXR";
const EXPECTED: &str = "an OpenEXR image";

/// Writes all channels as one part of scan lines, ZIP1.
pub(crate) fn write(layers: &Layers, path: &Path) -> Result<(), ImagingError> {
    // Names were checked when they were inserted: they fit the format's one byte a character.
    let named: Vec<_> = layers.channels().collect();
    let channels: Vec<AnyChannel<FlatSamples>> = named
        .par_iter()
        .map(|(name, channel)| {
            let samples = match channel.precision {
                Precision::Half => half_samples(channel.samples.pixels()),
                Precision::Full => FlatSamples::F32(channel.samples.pixels().to_vec()),
            };
            AnyChannel::new(Text::new_or_panic(name), samples)
        })
        .collect();
    let mut attributes = LayerAttributes::default();
    if layers.latlong {
        attributes.environment_map = Some(EnvironmentMap::LatitudeLongitude);
    }
    for (name, value) in layers.attributes() {
        // Checked when they were set.
        attributes.other.insert(
            Text::new_or_panic(name),
            AttributeValue::Text(Text::new_or_panic(value)),
        );
    }
    let encoding = Encoding {
        compression: Compression::ZIP1,
        ..Encoding::SMALL_LOSSLESS
    };
    let layer = Layer::new(
        (layers.width(), layers.height()),
        attributes,
        encoding,
        AnyChannels::sort(SmallVec::from_vec(channels)),
    );
    let file = File::create(path).map_err(|e| ImagingError::io("create", path, e))?;
    let mut writer = BufWriter::with_capacity(1 << 20, file);
    Image::from_layer(layer)
        .write()
        .to_buffered(&mut writer)
        .map_err(|error| write_error(path, error))?;
    writer
        .flush()
        .map_err(|e| ImagingError::io("write", path, e))
}

/// Half floats, unless a finite value would overflow to infinity.
fn half_samples(values: &[f32]) -> FlatSamples {
    if Precision::half_if_it_fits(values.iter().copied()) == Precision::Full {
        return FlatSamples::F32(values.to_vec());
    }
    let mut halves = vec![f16::ZERO; values.len()];
    halves.convert_from_f32_slice(values);
    FlatSamples::F16(halves)
}

/// Opens `path` and reads as [`read`], after a look at its first bytes.
pub(crate) fn open(path: &Path) -> Result<Layers, ImagingError> {
    let failed = |e| ImagingError::io("read", path, e);
    let file = dipir_files::open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    let mut reader = BufReader::with_capacity(1 << 20, file);
    let start = reader.fill_buf().map_err(failed)?;
    if start.is_empty() {
        return Err(ImagingError::Empty {
            path: path.to_owned(),
            expected: EXPECTED,
        });
    }
    match Format::of(&start[..start.len().min(Format::SNIFF_LENGTH)]) {
        Format::Exr => read(reader, length, path, None, SizeLimit::Any),
        other => Err(other.refuse(path, EXPECTED)),
    }
}

/// Reads the channels `names`, or all, onto the display window. A name that the file lacks is
/// left out; asking the layers for it is an error. `length` is the file's, in bytes: more samples
/// than it can hold are refused before they are allocated. `limit` is that of each part.
pub(crate) fn read(
    source: impl Read + Seek + Send,
    length: u64,
    path: &Path,
    names: Option<&[&str]>,
    limit: SizeLimit,
) -> Result<Layers, ImagingError> {
    let refused = Rc::new(Cell::new(None));
    let reader = ReadAnyChannels {
        read_samples: WantedSamples {
            names: names.map(|names| names.iter().map(|name| name.to_string()).collect()),
            samples_left: Cell::new(length.saturating_mul(MOST_SAMPLES_A_BYTE)),
            limit,
            path: path.to_owned(),
            refused: refused.clone(),
        },
    };
    let image = reader
        .all_layers()
        .all_attributes()
        .from_buffered(source)
        .map_err(|error| match refused.take() {
            Some(Refused::Size(width, height)) => match limit.check(path, width, height) {
                Err(refused) => refused,
                Ok(()) => read_error(path, error),
            },
            Some(Refused::Length) => ImagingError::Damaged {
                path: path.to_owned(),
                format: FORMAT,
                detail: "it declares more pixels than a file of its length can hold".into(),
            },
            None => read_error(path, error),
        })?;

    let window = image.attributes.display_window;
    let (width, height) = (window.size.0, window.size.1);
    limit.check(path, width, height)?;
    let mut layers = Layers::from_file(width, height, path);
    for part in image.layer_data {
        if part.attributes.environment_map == Some(EnvironmentMap::LatitudeLongitude) {
            layers.latlong = true;
        }
        for (name, value) in &part.attributes.other {
            if let AttributeValue::Text(text) = value {
                layers.keep_attribute(name.to_string(), text.to_string());
            }
        }
        let part_name = part.attributes.layer_name.as_ref().map(Text::to_string);
        let at = part.attributes.layer_position;
        let offset = (
            i64::from(at.0) - i64::from(window.position.0),
            i64::from(at.1) - i64::from(window.position.1),
        );
        for channel in part.channel_data.list {
            let Some((precision, values)) = channel.sample_data else {
                layers.note_skipped(channel.name.to_string());
                continue;
            };
            let mut name = channel.name.to_string();
            if let (true, Some(part)) = (layers.contains(&name), &part_name) {
                name = format!("{part}.{name}");
            }
            let samples = place(values, part.size, offset, (width, height));
            layers.insert(name, precision, samples)?;
        }
    }
    Ok(layers)
}

/// Moves a data window onto the display window.
fn place(
    values: Vec<f32>,
    size: Vec2<usize>,
    offset: (i64, i64),
    display: (usize, usize),
) -> Raster<f32> {
    let (width, height) = display;
    if offset == (0, 0) && (size.0, size.1) == display {
        return Raster::from_pixels(width, height, values);
    }
    let mut placed = Raster::filled(width, height, 0.0);
    for (row, line) in values.chunks_exact(size.0).enumerate() {
        let y = row as i64 + offset.1;
        if !(0..height as i64).contains(&y) {
            continue;
        }
        for (column, &value) in line.iter().enumerate() {
            let x = column as i64 + offset.0;
            if (0..width as i64).contains(&x) {
                *placed.get_mut(x as usize, y as usize) = value;
            }
        }
    }
    placed
}

fn read_error(path: &Path, error: exr::error::Error) -> ImagingError {
    match error {
        exr::error::Error::Io(source) => ImagingError::io("read", path, source),
        exr::error::Error::NotSupported(what) => ImagingError::Unsupported {
            path: path.to_owned(),
            what: format!("uses {what}"),
            remedy: "save it as scan lines with ZIP compression",
        },
        other => ImagingError::Damaged {
            path: path.to_owned(),
            format: FORMAT,
            detail: other.to_string(),
        },
    }
}

fn write_error(path: &Path, error: exr::error::Error) -> ImagingError {
    let source = match error {
        exr::error::Error::Io(source) => source,
        other => std::io::Error::other(other.to_string()),
    };
    ImagingError::io("write", path, source)
}

/// Reads every channel straight to f32, and keeps only those that are wanted.
struct WantedSamples {
    names: Option<Vec<String>>,
    /// How many more the file can hold.
    samples_left: Cell<u64>,
    limit: SizeLimit,
    path: PathBuf,
    /// Why the file is not read.
    refused: Rc<Cell<Option<Refused>>>,
}

#[derive(Clone, Copy)]
enum Refused {
    /// Width and height of a part.
    Size(usize, usize),
    /// The file is too short for what it declares.
    Length,
}

/// Samples that a byte of a file can stand for. Deflate makes at most 1032 bytes of one, and two
/// bytes are the shortest sample; lossy codings of flat blocks reach a few times as much.
const MOST_SAMPLES_A_BYTE: u64 = 2048;

struct WantedSamplesReader {
    kept: Option<(SampleType, Vec<f32>)>,
    size: Vec2<usize>,
    /// One line before conversion.
    halves: Vec<f16>,
}

impl ReadSamples for WantedSamples {
    type Reader = WantedSamplesReader;

    fn create_sample_reader(
        &self,
        header: &Header,
        channel: &ChannelDescription,
    ) -> exr::error::Result<WantedSamplesReader> {
        let size = header.layer_size;
        let wanted = self
            .names
            .as_ref()
            .is_none_or(|names| names.iter().any(|name| channel.name == *name.as_str()));
        if wanted && channel.sampling != Vec2(1, 1) {
            return Err(exr::error::Error::NotSupported(
                format!("subsampled channels (`{}`)", channel.name).into(),
            ));
        }
        let refuse = |why| {
            self.refused.set(Some(why));
            Err(exr::error::Error::Aborted)
        };
        if self.limit.check(&self.path, size.0, size.1).is_err() {
            return refuse(Refused::Size(size.0, size.1));
        }
        let area = size.0 * size.1;
        if wanted {
            match self.samples_left.get().checked_sub(area as u64) {
                Some(left) => self.samples_left.set(left),
                None => return refuse(Refused::Length),
            }
        }
        Ok(WantedSamplesReader {
            kept: wanted.then(|| (channel.sample_type, vec![0.0; area])),
            size,
            halves: Vec::new(),
        })
    }
}

impl SamplesReader for WantedSamplesReader {
    type Samples = Option<(Precision, Vec<f32>)>;

    fn filter_block(&self, tile: TileCoordinates) -> bool {
        tile.level_index == Vec2(0, 0)
    }

    fn read_line(&mut self, line: LineRef<'_>) -> exr::error::UnitResult {
        let Some((kind, samples)) = &mut self.kept else {
            return Ok(());
        };
        let at = line.location;
        let start = at.position.1 * self.size.0 + at.position.0;
        let target = &mut samples[start..start + at.sample_count];
        match kind {
            SampleType::F32 => line.read_samples_into_slice(target)?,
            SampleType::F16 => {
                self.halves.resize(at.sample_count, f16::ZERO);
                line.read_samples_into_slice(&mut self.halves)?;
                self.halves.convert_to_f32_slice(target);
            }
            SampleType::U32 => {
                for (to, from) in target.iter_mut().zip(line.read_samples::<u32>()) {
                    *to = from? as f32;
                }
            }
        }
        Ok(())
    }

    fn into_samples(self) -> Self::Samples {
        let (kind, samples) = self.kept?;
        let precision = match kind {
            SampleType::F16 => Precision::Half,
            SampleType::F32 | SampleType::U32 => Precision::Full,
        };
        Some((precision, samples))
    }
}
