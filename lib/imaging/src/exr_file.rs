//! OpenEXR files in and out, between the `exr` library and [`Layers`].
use crate::{
    decode::SizeLimit,
    error::ImagingError,
    format::Format,
    layer_rows::{LayerRows, Packing, RowChannel},
    layers::{Layers, Precision, check_name},
    primaries::Primaries,
    raster::Raster,
};
use exr::{
    block::{
        chunk::TileCoordinates,
        lines::{LineRef, LineRefMut},
    },
    image::{
        read::{
            any_channels::{ReadAnyChannels, ReadSamples, SamplesReader},
            layers::ReadChannels,
        },
        write::{
            WritableImage,
            samples::{SamplesWriter, WritableSamples},
        },
    },
    math::{RoundingMode, Vec2},
    meta::{
        attribute::{
            AttributeValue, ChannelDescription, EnvironmentMap, LevelMode, SampleType, Text,
        },
        header::{Header, LayerAttributes},
    },
    prelude::{AnyChannel, AnyChannels, Compression, Encoding, Image, Layer, ReadLayers},
};
use half::{f16, slice::HalfFloatSliceExt};
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

/// Writes all channels as one part of scan lines. Rows are asked for when they are due.
pub(crate) fn write(layers: &LayerRows, path: &Path) -> Result<(), ImagingError> {
    // Names were checked when they were inserted: they fit the format's one byte a character.
    let channels = layers
        .channels
        .iter()
        .map(|(name, channel)| AnyChannel::new(Text::new_or_panic(name), Rows(channel)));
    let mut attributes = LayerAttributes::default();
    if layers.latlong {
        attributes.environment_map = Some(EnvironmentMap::LatitudeLongitude);
    }
    let encoding = Encoding {
        compression: match layers.packing {
            Packing::Small => Compression::ZIP1,
            Packing::Quick => Compression::RLE,
        },
        ..Encoding::SMALL_LOSSLESS
    };
    let layer = Layer::new(
        (layers.width, layers.height),
        attributes,
        encoding,
        AnyChannels::sort(channels.collect()),
    );
    let file = File::create(path).map_err(|e| ImagingError::io("create", path, e))?;
    let mut writer = BufWriter::with_capacity(1 << 20, file);
    let mut image = Image::from_layer(layer);
    image.attributes.chromaticities = layers.primaries.map(Primaries::to_exr);
    image
        .write()
        .to_buffered(&mut writer)
        .map_err(|error| write_error(path, error))?;
    writer
        .flush()
        .map_err(|e| ImagingError::io("write", path, e))
}

/// A channel whose samples are computed row by row.
#[derive(Clone, Copy)]
struct Rows<'a>(&'a RowChannel<'a>);

impl<'s, 'a: 's> WritableSamples<'s> for Rows<'a> {
    type Writer = Self;

    fn sample_type(&self) -> SampleType {
        match self.0.precision {
            Precision::Half => SampleType::F16,
            Precision::Full => SampleType::F32,
        }
    }

    fn infer_level_modes(&self) -> (LevelMode, RoundingMode) {
        (LevelMode::Singular, RoundingMode::Down)
    }

    fn create_samples_writer(&'s self, _: &Header) -> Self {
        *self
    }
}

impl SamplesWriter for Rows<'_> {
    fn extract_line(&self, line: LineRefMut<'_>) {
        // Scan lines: a line is a whole row.
        let mut row = vec![0.0; line.location.sample_count];
        (self.0.fill)(line.location.position.1, &mut row);
        let written = match self.0.precision {
            Precision::Full => line.write_samples_from_slice(&row),
            Precision::Half => {
                let mut halves = vec![f16::ZERO; row.len()];
                halves.convert_from_f32_slice(&row);
                line.write_samples_from_slice(&halves)
            }
        };
        // The line is memory of the length that was asked for.
        written.expect("a row has the samples of a line");
    }
}

/// Opens `path` and reads as [`read`], after a look at its first bytes. With `longest`, blocks of pixels are averaged while
/// they are read: the longer side gets `longest` pixels at least, and less than twice as many.
pub(crate) fn open(path: &Path, longest: Option<usize>) -> Result<Layers, ImagingError> {
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
        Format::Exr => read_small(reader, length, path, None, SizeLimit::Any, longest),
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
    read_small(source, length, path, names, limit, None)
}

fn read_small(
    source: impl Read + Seek + Send,
    length: u64,
    path: &Path,
    names: Option<&[&str]>,
    limit: SizeLimit,
    longest: Option<usize>,
) -> Result<Layers, ImagingError> {
    let refused = Rc::new(Cell::new(None));
    let reader = ReadAnyChannels {
        read_samples: WantedSamples {
            names: names.map(|names| names.iter().map(|name| name.to_string()).collect()),
            samples_left: Cell::new(length.saturating_mul(MOST_SAMPLES_A_BYTE)),
            limit,
            longest,
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
    let filled = width as u64 * height as u64;
    if filled > MOST_EMPTY_PIXELS.max(length.saturating_mul(MOST_SAMPLES_A_BYTE)) {
        return Err(ImagingError::Damaged {
            path: path.to_owned(),
            format: FORMAT,
            detail: format!(
                "its display window is {width} x {height} pixels, and almost nothing of that is in the file"
            ),
        });
    }
    let block = block_side(longest, window.size);
    let (width, height) = (width.div_ceil(block), height.div_ceil(block));
    let mut layers = Layers::from_file(width, height, path);
    let chromaticities = image.attributes.chromaticities.as_ref();
    layers.primaries = chromaticities.and_then(Primaries::of_exr);
    layers.pixel_aspect = image.attributes.pixel_aspect;
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
            // Blender's passes have spaces in their names, and nothing here asks for them.
            if check_name(&name).is_err() {
                layers.note_skipped(name);
                continue;
            }
            if reaches_beyond(part.size, offset, window.size) {
                layers.overscan.get_or_insert((part.size.0, part.size.1));
            }
            let samples = match block {
                1 => place(values, part.size, offset, (width, height)),
                _ => Raster::from_pixels(width, height, values),
            };
            layers.insert(name, precision, samples)?;
        }
    }
    Ok(layers)
}

/// Whether a data window has pixels outside the display window.
fn reaches_beyond(size: Vec2<usize>, offset: (i64, i64), display: Vec2<usize>) -> bool {
    let beyond = |at: i64, length: usize, all: usize| {
        at < 0 || at.saturating_add(length as i64) > all as i64
    };
    beyond(offset.0, size.0, display.0) || beyond(offset.1, size.1, display.1)
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
            remedy: "save it as scan lines with ZIP compression".into(),
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
    /// As in [`open`].
    longest: Option<usize>,
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

/// Pixels of a display window that a file may leave empty: 8192 x 4096.
const MOST_EMPTY_PIXELS: u64 = 1 << 25;

/// Samples that a byte of a file can stand for. Deflate makes at most 1032 bytes of one, and two
/// bytes are the shortest sample; lossy codings of flat blocks reach a few times as much.
const MOST_SAMPLES_A_BYTE: u64 = 2048;

struct WantedSamplesReader {
    kept: Option<(SampleType, Vec<f32>)>,
    size: Vec2<usize>,
    /// One line before conversion.
    halves: Vec<f16>,
    means: Option<Means>,
}

/// Means of blocks of pixels, without values that are not finite: depth is infinite where there is nothing.
struct Means {
    /// Side of a block, and blocks of a row.
    block: usize,
    columns: usize,
    /// Sum and number of the finite values of each block. In f64 sums of halves are exact, so the order in which lines
    /// arrive does not show.
    sums: Vec<f64>,
    counts: Vec<u32>,
    line: Vec<f32>,
}

impl Means {
    /// Adds the line, which begins at `(x, y)`. A block without a finite value has one of its values in `samples`.
    fn add(&mut self, samples: &mut [f32], (x, y): (usize, usize)) {
        let first = y / self.block * self.columns + x / self.block;
        // A tile may begin within a block.
        let lead = (self.block - x % self.block).min(self.line.len());
        let (lead, rest) = self.line.split_at(lead);
        let parts = std::iter::once(lead).chain(rest.chunks(self.block));
        for (at, values) in (first..).zip(parts) {
            for &value in values {
                match value.is_finite() {
                    true => {
                        self.sums[at] += f64::from(value);
                        self.counts[at] += 1;
                    }
                    false => samples[at] = value,
                }
            }
        }
    }
}

/// Side of the blocks whose mean is kept.
fn block_side(longest: Option<usize>, size: Vec2<usize>) -> usize {
    longest.map_or(1, |n| (size.0.max(size.1) / n.max(1)).max(1))
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
        let window = header.shared_attributes.display_window;
        let block = block_side(self.longest, window.size);
        if block > 1
            && (size != window.size || header.own_attributes.layer_position != window.position)
        {
            return Err(exr::error::Error::NotSupported(
                "a data window of its own in a picture that is read smaller".into(),
            ));
        }
        if wanted {
            let area = size.0 as u64 * size.1 as u64;
            match self.samples_left.get().checked_sub(area) {
                Some(left) => self.samples_left.set(left),
                None => return refuse(Refused::Length),
            }
        }
        let (columns, rows) = (size.0.div_ceil(block), size.1.div_ceil(block));
        Ok(WantedSamplesReader {
            kept: wanted.then(|| (channel.sample_type, vec![0.0; columns * rows])),
            size,
            halves: Vec::new(),
            means: (wanted && block > 1).then(|| Means {
                block,
                columns,
                sums: vec![0.0; columns * rows],
                counts: vec![0; columns * rows],
                line: Vec::new(),
            }),
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
        let target = match &mut self.means {
            Some(means) => {
                means.line.resize(at.sample_count, 0.0);
                &mut means.line[..]
            }
            None => {
                let start = at.position.1 * self.size.0 + at.position.0;
                &mut samples[start..start + at.sample_count]
            }
        };
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
        if let Some(means) = &mut self.means {
            means.add(samples, (at.position.0, at.position.1));
        }
        Ok(())
    }

    fn into_samples(self) -> Self::Samples {
        let (kind, mut samples) = self.kept?;
        if let Some(Means { sums, counts, .. }) = self.means {
            for (sample, (sum, count)) in samples.iter_mut().zip(sums.into_iter().zip(counts)) {
                if count > 0 {
                    *sample = (sum / f64::from(count)) as f32;
                }
            }
        }
        let precision = match kind {
            SampleType::F16 => Precision::Half,
            SampleType::F32 | SampleType::U32 => Precision::Full,
        };
        Some((precision, samples))
    }
}
