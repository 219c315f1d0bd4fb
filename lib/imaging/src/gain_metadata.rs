//! What the values of a gain map mean: in XMP (`http://ns.adobe.com/hdr-gain-map/1.0/`) or in binary [ISO 21496-1].

const XMP: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";
const NAMESPACE: &[u8] = b"http://ns.adobe.com/hdr-gain-map/1.0/";
const BINARY: &[u8] = b"urn:iso:std:iso:ts:21496:-1\0";
/// The most stops of a gain. Cameras take 4 at most.
const MOST_STOPS: f32 = 16.0;

/// What the values of one channel mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Channel {
    /// Stops of the value 0.
    min: f32,
    /// Stops of the value 1.
    max: f32,
    /// The exponent with which values are stored.
    gamma: f32,
    /// Added to the picture's light before the gain.
    offset: f32,
    /// Taken off afterwards.
    offset_after: f32,
}

impl Channel {
    /// The gain that a value in `[0, 1]` means.
    pub fn factor(&self, value: f32) -> f32 {
        let share = match self.gamma == 1.0 {
            true => value,
            false => value.powf(self.gamma.recip()),
        };
        (self.min + (self.max - self.min) * share).exp2()
    }

    /// Light with a gain that is above 1, else the light itself.
    pub fn brighter(&self, light: f32, factor: f32) -> f32 {
        match factor > 1.0 {
            true => light.max((light + self.offset) * factor - self.offset_after),
            false => light,
        }
    }

    /// Errors with what a channel's number is and must not be.
    fn checked(self) -> Result<Self, String> {
        let within = |name: &str, value: f32, most: f32| match value.abs() <= most {
            true => Ok(()),
            false => Err(format!("its {name} is {value}, beyond {most}")),
        };
        within("least gain in stops", self.min, MOST_STOPS)?;
        within("greatest gain in stops", self.max, MOST_STOPS)?;
        within("offset", self.offset, 1.0)?;
        within("offset of the brighter picture", self.offset_after, 1.0)?;
        if self.min > self.max {
            let (min, max) = (self.min, self.max);
            return Err(format!(
                "its least gain, {min} stops, is above the greatest, {max}"
            ));
        }
        // A NaN is no more above 0 than 0 is.
        match self.gamma > 0.0 && self.gamma.is_finite() {
            true => Ok(self),
            false => Err(format!("its gamma is {}", self.gamma)),
        }
    }
}

/// Whether a JPEG says that a gain map comes behind it.
pub(crate) fn is_announced(jpeg: &[u8]) -> bool {
    segments(jpeg).any(|(marker, content)| match marker {
        0xe1 => xmp(content).is_some(),
        0xe2 => content.starts_with(BINARY),
        _ => false,
    })
}

/// What a JPEG says of its values as a gain map; `None` where it is another picture.
///
/// # Errors
/// With what is wrong, in words.
pub(crate) fn of(jpeg: &[u8]) -> Option<Result<[Channel; 3], String>> {
    let binary = segments(jpeg).find_map(|(marker, content)| {
        // Versions alone announce a gain map behind this picture.
        let data = content.strip_prefix(BINARY).filter(|d| d.len() > 4)?;
        (marker == 0xe2).then(|| of_binary(data))
    });
    let by_xmp = || {
        segments(jpeg).find_map(|(marker, content)| {
            let text = xmp(content).filter(|_| marker == 0xe1)?;
            of_xmp(&String::from_utf8_lossy(text)).transpose()
        })
    };
    match binary {
        Some(Err(why)) => Some(by_xmp().filter(Result::is_ok).unwrap_or(Err(why))),
        None => by_xmp(),
        found => found,
    }
}

/// The markers and contents of the segments before a JPEG's picture.
fn segments(jpeg: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    let mut rest = jpeg.get(2..).unwrap_or_default();
    std::iter::from_fn(move || {
        let [0xff, marker, high, low] = *rest.first_chunk()? else {
            return None;
        };
        let length = usize::from(u16::from_be_bytes([high, low]));
        let content = rest.get(4..2 + length)?;
        rest = &rest[2 + length..];
        // The picture begins.
        (marker != 0xda).then_some((marker, content))
    })
}

/// The XMP of a segment that is about a gain map.
fn xmp(content: &[u8]) -> Option<&[u8]> {
    let text = content.strip_prefix(XMP)?;
    let mut all = text.windows(NAMESPACE.len());
    all.any(|w| w == NAMESPACE).then_some(text)
}

/// `None` if the text has the namespace and no gains: that of a picture with a gain map behind it.
fn of_xmp(xmp: &str) -> Result<Option<[Channel; 3]>, String> {
    let Some(max) = numbers(xmp, "GainMapMax")? else {
        return Ok(None);
    };
    if value(xmp, "BaseRenditionIsHDR").is_some_and(|v| v.trim().eq_ignore_ascii_case("true")) {
        return Err(BACKWARDS.into());
    }
    let or = |name: &str, default: f32| Ok(numbers(xmp, name)?.unwrap_or([default; 3]));
    let (min, gamma) = (or("GainMapMin", 0.0)?, or("Gamma", 1.0)?);
    let offsets: Result<_, String> =
        or("OffsetSDR", 1.0 / 64.0).and_then(|sdr| Ok((sdr, or("OffsetHDR", 1.0 / 64.0)?)));
    let (offset, offset_after) = offsets?;
    let channel = |k: usize| Channel {
        min: min[k],
        max: max[k],
        gamma: gamma[k],
        offset: offset[k],
        offset_after: offset_after[k],
    };
    checked([0, 1, 2].map(channel)).map(Some)
}

const BACKWARDS: &str = "it leads from a brighter picture to a darker one";

/// The text of `hdrgm:NAME="text"` or `<hdrgm:NAME>text</hdrgm:NAME>`.
fn value<'a>(xmp: &'a str, name: &str) -> Option<&'a str> {
    let tag = format!("hdrgm:{name}");
    xmp.match_indices(&tag).find_map(|(at, _)| {
        let rest = xmp[at + tag.len()..].trim_start();
        if let Some(inside) = rest.strip_prefix('>') {
            return Some(inside.split_once(&format!("</{tag}"))?.0);
        }
        let rest = rest.strip_prefix('=')?.trim_start();
        let quote = rest.chars().next().filter(|c| matches!(c, '"' | '\''))?;
        Some(rest[1..].split_once(quote)?.0)
    })
}

/// A number for each channel: one for all, or a list of three.
fn numbers(xmp: &str, name: &str) -> Result<Option<[f32; 3]>, String> {
    let Some(text) = value(xmp, name) else {
        return Ok(None);
    };
    let wrong = || {
        let start: String = text.chars().take(40).collect();
        format!("its {name} is `{start}`, no number and no three")
    };
    let number = |text: &str| text.trim().parse::<f32>().map_err(|_| wrong());
    if !text.contains("<rdf:li") {
        return Ok(Some([number(text)?; 3]));
    }
    let item = |part: &str| {
        let (_, inside) = part.split_once('>').ok_or_else(wrong)?;
        number(inside.split('<').next().unwrap_or_default())
    };
    let items: Vec<f32> = text
        .split("<rdf:li")
        .skip(1)
        .map(item)
        .collect::<Result<_, _>>()?;
    match items[..] {
        [all] => Ok(Some([all; 3])),
        [r, g, b] => Ok(Some([r, g, b])),
        _ => Err(wrong()),
    }
}

/// Fields of ISO 21496-1: fractions with signed or unsigned numerators, each with a denominator unless all share one.
fn of_binary(data: &[u8]) -> Result<[Channel; 3], String> {
    /// More than one channel.
    const SEVERAL: u8 = 1 << 7;
    /// Written by programs before the standard was final: from the brighter picture, and one denominator for all.
    const BACKWARD: u8 = 1 << 2;
    const COMMON: u8 = 1 << 3;
    let short = || "its metadata are cut off".to_string();
    let (&[high, low, _, _, flags], mut rest) = data.split_first_chunk().ok_or_else(short)?;
    let version = u16::from_be_bytes([high, low]);
    if version != 0 {
        return Err(format!("it wants a reader of version {version}"));
    }
    let mut word = || {
        let (word, after) = rest.split_first_chunk::<4>().ok_or_else(short)?;
        rest = after;
        Ok::<_, String>(u32::from_be_bytes(*word))
    };
    let common = match flags & COMMON {
        0 => None,
        _ => Some(word()?),
    };
    let mut fraction = |signed: bool| {
        let numerator = match (word()?, signed) {
            (n, true) => f64::from(n as i32),
            (n, false) => f64::from(n),
        };
        match common.map_or_else(&mut word, Ok)? {
            0 => Err("a fraction of its metadata has the denominator 0".to_string()),
            denominator => Ok((numerator / f64::from(denominator)) as f32),
        }
    };
    let (base, other) = (fraction(false)?, fraction(false)?);
    if flags & BACKWARD != 0 || base > other {
        return Err(BACKWARDS.into());
    }
    let mut channel = || {
        Ok::<_, String>(Channel {
            min: fraction(true)?,
            max: fraction(true)?,
            gamma: fraction(false)?,
            offset: fraction(true)?,
            offset_after: fraction(true)?,
        })
    };
    let first = channel()?;
    checked(match flags & SEVERAL {
        0 => [first; 3],
        _ => [first, channel()?, channel()?],
    })
}

fn checked([r, g, b]: [Channel; 3]) -> Result<[Channel; 3], String> {
    Ok([r.checked()?, g.checked()?, b.checked()?])
}
