//! What a photograph's Exif data say of how it was taken.
use std::io::BufReader;
use std::path::Path;

use crate::sensors;
use exif::{Exif, In, Tag, Value};
use image::metadata::Orientation;
use serde::{Deserialize, Serialize};

/// Facts about a photograph. Lengths and pixels are those of the upright picture, as people see it.
/// What the file does not say, or says wrongly, is `None`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Facts {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// The turn that made the stored picture upright, 1 to 8; 1 is none [Exif 2.3, Orientation].
    pub orientation: u8,
    /// Maker of the camera.
    pub make: Option<String>,
    /// Name of the camera.
    pub model: Option<String>,
    /// Focal length of the lens, millimetres.
    pub focal_mm: Option<f64>,
    /// Width and height of the part of the sensor that is the picture, millimetres.
    pub sensor_mm: Option<[f64; 2]>,
    /// Where the sensor's size, or the focal length for one of 35 mm, comes from.
    pub focal_source: Option<FocalSource>,
    /// Focal length over pixel pitch, pixels.
    pub focal_px: Option<f64>,
    /// f-number of the lens.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub f_number: Option<f64>,
    /// When it was taken, ISO 8601: `2026-06-21T12:34:56+02:00`. Without an offset at its end it is
    /// the local time of an unknown zone.
    pub time: Option<String>,
    /// Degrees north of the equator.
    pub latitude_deg: Option<f64>,
    /// Degrees east of Greenwich.
    pub longitude_deg: Option<f64>,
    /// Metres above sea level.
    pub altitude_m: Option<f64>,
    /// Where the camera looked, degrees clockwise from north.
    pub heading: Option<Heading>,
    /// How much the camera exposed, stops: of the same light, a photograph with one more is twice as bright. It is
    /// the logarithm of seconds times ISO over the square of the f-number.
    #[serde(default)]
    pub exposure_stops: Option<f64>,
}

/// A compass bearing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Heading {
    /// Degrees clockwise from north, in `[0, 360)`.
    pub deg: f64,
    /// Whether north is where the needle points; else it is true north.
    pub magnetic: bool,
}

/// From what a field of view was found, the surest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FocalSource {
    /// The focal length of a 35 mm camera with the same diagonal angle of view.
    Equivalent35mm,
    /// Pixels a millimetre of the sensor.
    FocalPlaneResolution,
    /// A table of cameras.
    Table,
}

/// Diagonal of a 36 x 24 mm frame, millimetres; equivalent focal lengths compare diagonals [CIPA
/// DCG-001].
const DIAGONAL_35MM: f64 = 43.266_615_305_567_87;

impl Facts {
    /// Facts about an upright picture of `size` pixels without Exif data.
    pub fn of_size(size: [u32; 2]) -> Self {
        Self {
            size,
            orientation: 1,
            ..Self::default()
        }
    }

    /// Reads Exif data, from its TIFF header on, of an upright picture of `size` pixels. Damaged
    /// data give fewer facts.
    pub fn of_exif(exif: &[u8], size: [u32; 2]) -> Self {
        let mut facts = Self::of_size(size);
        if let Some(turn) = Orientation::from_exif_chunk(exif) {
            facts.orientation = turn.to_exif();
        }
        if let Some(exif) = parsed(exif) {
            let fields = Fields(&exif);
            facts.make = fields.text(Tag::Make);
            facts.model = fields.text(Tag::Model);
            facts.read_lens(&fields);
            facts.time = fields.time();
            facts.exposure_stops = fields.exposure_stops();
            facts.read_place(&fields);
        }
        facts
    }

    /// [`Facts::exposure_stops`] of the PNG or JPEG in `path`, whose pixels are not read; `None` as well if it cannot be read.
    pub fn exposure_stops_of(path: &Path) -> Option<f64> {
        let mut file = BufReader::new(dipir_files::open(path).ok()?);
        let mut reader = exif::Reader::new();
        let read = reader
            .continue_on_error(true)
            .read_from_container(&mut file)
            .or_else(|e| e.distill_partial_result(|_| {}));
        Fields(&read.ok()?).exposure_stops()
    }

    /// Whether the upright picture's width is the stored picture's height.
    fn on_its_side(&self) -> bool {
        self.orientation >= 5
    }

    fn read_lens(&mut self, fields: &Fields) {
        let [w, h] = self.size.map(f64::from);
        let diagonal_px = w.hypot(h);
        self.focal_mm = fields.positive(Tag::FocalLength);
        self.f_number = fields.positive(Tag::FNumber);
        // A digital zoom crops the sensor; the equivalent focal length includes it.
        let zoom = fields
            .positive(Tag::DigitalZoomRatio)
            .unwrap_or(1.0)
            .max(1.0);
        let extent = |pitch_mm: f64| [w * pitch_mm, h * pitch_mm];
        if let Some(equivalent) = fields.positive(Tag::FocalLengthIn35mmFilm) {
            let focal_px = equivalent / DIAGONAL_35MM * diagonal_px;
            self.focal_px = Some(focal_px);
            self.sensor_mm = self.focal_mm.map(|f| extent(f / focal_px));
            self.focal_source = Some(FocalSource::Equivalent35mm);
            return;
        }
        let pitch = self.pitch_of_resolution(fields).map(|p| p / zoom);
        let (pitch, source) = match pitch {
            Some(pitch) => (pitch, FocalSource::FocalPlaneResolution),
            None => {
                let (make, model) = (self.make.as_deref(), self.model.as_deref());
                let Some([long, short]) = sensors::size_mm(make, model) else {
                    return;
                };
                // Pixels are square: of another shape than the sensor's, the picture is cut out.
                let (long_px, short_px) = (w.max(h), w.min(h));
                let pitch = (long / long_px).min(short / short_px);
                (pitch / zoom, FocalSource::Table)
            }
        };
        self.focal_px = self.focal_mm.map(|f| f / pitch);
        self.sensor_mm = Some(extent(pitch));
        self.focal_source = Some(source);
    }

    /// Pixel pitch of this picture, millimetres, from the resolution of the focal plane.
    fn pitch_of_resolution(&self, fields: &Fields) -> Option<f64> {
        let per_unit = fields.positive(Tag::FocalPlaneXResolution)?;
        let unit_mm = match fields.uint(Tag::FocalPlaneResolutionUnit).unwrap_or(2) {
            2 => 25.4,
            3 => 10.0,
            4 => 1.0,
            5 => 1e-3,
            _ => return None,
        };
        // The resolution belongs to the picture as it was taken, which may have been scaled since.
        let now = f64::from(self.size[usize::from(self.on_its_side())]);
        let taken = fields.positive(Tag::PixelXDimension).unwrap_or(now);
        let pitch = unit_mm / per_unit * taken / now;
        // A sensor is between 1 mm and 200 mm wide: some makers write other things here.
        (1.0..200.0).contains(&(pitch * now)).then_some(pitch)
    }

    fn read_place(&mut self, fields: &Fields) {
        let signed = |tag, sign_tag, negative: &str, most: f64| {
            // Devices that do not know their place write degrees of 0/0.
            fields.number(tag)?;
            let parts = fields.rationals(tag)?;
            let [degrees, minutes, seconds] = [0, 1, 2].map(|i| parts.get(i).copied());
            let value = degrees? + minutes.unwrap_or(0.0) / 60.0 + seconds.unwrap_or(0.0) / 3600.0;
            let sign = match fields.text(sign_tag)?.eq_ignore_ascii_case(negative) {
                true => -1.0,
                false => 1.0,
            };
            (value <= most).then_some(sign * value)
        };
        let latitude = signed(Tag::GPSLatitude, Tag::GPSLatitudeRef, "S", 90.0);
        let longitude = signed(Tag::GPSLongitude, Tag::GPSLongitudeRef, "W", 180.0);
        // Others write zeros.
        let place = latitude.zip(longitude).filter(|p| *p != (0.0, 0.0));
        if let Some((latitude, longitude)) = place {
            self.latitude_deg = Some(latitude);
            self.longitude_deg = Some(longitude);
        }
        self.altitude_m =
            fields
                .number(Tag::GPSAltitude)
                .map(|a| match fields.uint(Tag::GPSAltitudeRef) {
                    Some(1) => -a,
                    _ => a,
                });
        let bearing = fields.number(Tag::GPSImgDirection);
        self.heading = bearing
            .filter(|d| (0.0..=360.0).contains(d))
            .map(|d| Heading {
                deg: d % 360.0,
                magnetic: fields.text(Tag::GPSImgDirectionRef).as_deref() == Some("M"),
            });
    }

    /// Width of the part of the sensor that is the picture, millimetres: with a focal length in
    /// millimetres it gives the field of view.
    pub fn sensor_width_mm(&self) -> Option<f64> {
        self.sensor_mm.map(|s| s[0])
    }

    /// Horizontal and vertical angle of view, radians.
    pub fn field_of_view_rad(&self) -> Option<[f64; 2]> {
        let focal = self.focal_px?;
        Some(self.size.map(|n| 2.0 * (0.5 * f64::from(n) / focal).atan()))
    }
}

/// Exif data, from their TIFF header on; of damaged ones what can be read.
fn parsed(exif: &[u8]) -> Option<Exif> {
    let mut reader = exif::Reader::new();
    let read = reader.continue_on_error(true).read_raw(exif.to_vec());
    read.or_else(|e| e.distill_partial_result(|_| {})).ok()
}

/// Whether Exif data say that the values are Adobe RGB: cameras say so by the interoperability index `R03`, and write no
/// profile [DCF 2.0, 5.2.2].
pub(crate) fn is_adobe_rgb(exif: &[u8]) -> bool {
    const SRGB: u32 = 1;
    parsed(exif).is_some_and(|exif| {
        let fields = Fields(&exif);
        fields.text(Tag::InteroperabilityIndex).as_deref() == Some("R03")
            && fields.uint(Tag::ColorSpace) != Some(SRGB)
    })
}

/// Exif fields by tag, of the picture itself.
struct Fields<'a>(&'a Exif);

impl Fields<'_> {
    fn value(&self, tag: Tag) -> Option<&Value> {
        self.0.get_field(tag, In::PRIMARY).map(|f| &f.value)
    }

    fn uint(&self, tag: Tag) -> Option<u32> {
        self.value(tag)?.get_uint(0)
    }

    fn text(&self, tag: Tag) -> Option<String> {
        let Value::Ascii(lines) = self.value(tag)? else {
            return None;
        };
        let text = String::from_utf8_lossy(lines.first()?);
        let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
        (!text.is_empty()).then(|| text.chars().filter(|c| !c.is_control()).collect())
    }

    /// Fractions. Some makers write the signed type where the standard has the unsigned one.
    fn rationals(&self, tag: Tag) -> Option<Vec<f64>> {
        // The seconds of a place may be left out as 0/0.
        let quotient = |numerator: f64, denominator: f64| match denominator == 0.0 {
            true => 0.0,
            false => numerator / denominator,
        };
        match self.value(tag)? {
            Value::Rational(parts) => Some(
                parts
                    .iter()
                    .map(|r| quotient(f64::from(r.num), f64::from(r.denom)))
                    .collect(),
            ),
            Value::SRational(parts) => Some(
                parts
                    .iter()
                    .map(|r| quotient(f64::from(r.num), f64::from(r.denom)))
                    .collect(),
            ),
            _ => None,
        }
    }

    /// A finite number, as a fraction or whole.
    fn number(&self, tag: Tag) -> Option<f64> {
        match self.value(tag)? {
            Value::Rational(r) => r.first().map(exif::Rational::to_f64),
            Value::SRational(r) => r.first().map(exif::SRational::to_f64),
            other => other.get_uint(0).map(f64::from),
        }
        .filter(|v| v.is_finite())
    }

    /// A number above 0: an unknown one is written as 0.
    fn positive(&self, tag: Tag) -> Option<f64> {
        self.number(tag).filter(|&v| v > 0.0)
    }

    fn exposure_stops(&self) -> Option<f64> {
        let seconds = self.positive(Tag::ExposureTime)?;
        let f_number = self.positive(Tag::FNumber)?;
        let iso = self.positive(Tag::PhotographicSensitivity)?;
        Some((seconds * iso / (f_number * f_number)).log2())
    }

    /// Local time with its offset, else the satellites' universal time, else local time.
    fn time(&self) -> Option<String> {
        let dated = |tag| {
            let text = self.text(tag)?;
            let (day, clock) = text.split_once([' ', 'T'])?;
            Some(format!("{}T{}", iso_day(day)?, iso_clock(clock)?))
        };
        let local = dated(Tag::DateTimeOriginal).or_else(|| dated(Tag::DateTimeDigitized));
        let offset = self
            .text(Tag::OffsetTimeOriginal)
            .or_else(|| self.text(Tag::OffsetTime))
            .filter(|o| is_offset(o));
        let universal = || {
            let day = iso_day(&self.text(Tag::GPSDateStamp)?)?;
            // Devices that do not know the time write hours of 0/0.
            self.number(Tag::GPSTimeStamp)?;
            let parts = self.rationals(Tag::GPSTimeStamp)?;
            let [h, m, s] = [0, 1, 2].map(|i| parts.get(i).copied().unwrap_or(60.0) as u32);
            Some(format!(
                "{day}T{}Z",
                iso_clock(&format!("{h:02}:{m:02}:{s:02}"))?
            ))
        };
        match (local, offset) {
            (Some(local), Some(offset)) => Some(local + &offset),
            (local, _) => universal().or(local),
        }
    }
}

/// `2026:06:21` as `2026-06-21`, if it is a day.
fn iso_day(day: &str) -> Option<String> {
    let parts: Vec<u32> = day
        .split([':', '-'])
        .map_while(|p| p.parse().ok())
        .collect();
    match parts[..] {
        [y @ 1800..=9999, m @ 1..=12, d @ 1..=31] => Some(format!("{y:04}-{m:02}-{d:02}")),
        _ => None,
    }
}

/// `12:34:56` with two digits each, if it is a time of day.
fn iso_clock(clock: &str) -> Option<String> {
    let clock = clock.get(..8)?;
    let parts: Vec<u32> = clock.split(':').map_while(|p| p.parse().ok()).collect();
    match parts[..] {
        [h @ 0..=23, m @ 0..=59, s @ 0..=59] => Some(format!("{h:02}:{m:02}:{s:02}")),
        _ => None,
    }
}

/// Whether the text is `+hh:mm`, `-hh:mm` or `Z`.
fn is_offset(text: &str) -> bool {
    let Some(digits) = text.strip_prefix(['+', '-']) else {
        return text == "Z";
    };
    match digits.split_once(':') {
        Some((h, m)) => {
            let two = |t: &str| t.len() == 2 && t.bytes().all(|b| b.is_ascii_digit());
            two(h) && two(m)
        }
        None => false,
    }
}
