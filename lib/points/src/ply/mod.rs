//! PLY files, ASCII and binary of both byte orders: the header and the numbers.
mod vertices;

pub(crate) use vertices::read;

use crate::error::shown;

/// How numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Words between white space.
    Ascii,
    /// Binary, the lowest byte first.
    LittleEndian,
    /// Binary, the highest byte first.
    BigEndian,
}

/// The type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// What stands for a full colour channel.
    pub fn full(self) -> f64 {
        match self {
            Self::U8 => 255.0,
            Self::U16 => 65535.0,
            _ => 1.0,
        }
    }
}

/// A number, or a list of them, in every row of an element.
#[derive(Clone, Debug)]
pub struct Property {
    /// As the header says it.
    pub name: String,
    /// Type of a list's length; `None` for a single number.
    pub length: Option<Scalar>,
    /// Type of the numbers.
    pub kind: Scalar,
}

impl Property {
    /// How many numbers come next.
    ///
    /// # Errors
    /// If the list's length is no count, or the file ends.
    pub fn length(&self, input: &mut Input) -> Result<u64, String> {
        let Some(kind) = self.length else {
            return Ok(1);
        };
        let n = input.number(kind)?;
        match n >= 0.0 && n.fract() == 0.0 {
            true => Ok(n as u64),
            false => Err(format!("a list of {n} numbers")),
        }
    }

    /// Passes over the numbers of a row.
    ///
    /// # Errors
    /// If one of them is missing.
    pub fn skip(&self, input: &mut Input) -> Result<(), String> {
        for _ in 0..self.length(input)? {
            input.number(self.kind)?;
        }
        Ok(())
    }
}

/// Rows of the same properties.
#[derive(Clone, Debug)]
pub struct Element {
    /// `vertex`, `face` or another.
    pub name: String,
    /// Rows, as the header says.
    pub count: u64,
    /// What each row holds, in this order.
    pub properties: Vec<Property>,
}

impl Element {
    /// Rows that take bytes: none without properties, whatever the count.
    pub fn rows(&self) -> u64 {
        match self.properties.is_empty() {
            true => 0,
            false => self.count,
        }
    }
}

/// What a file says before its numbers.
#[derive(Clone, Debug)]
pub struct Header {
    /// How the numbers are written.
    pub format: Format,
    /// What they are, in the file's order.
    pub elements: Vec<Element>,
}

impl Header {
    /// The header and the numbers behind it.
    ///
    /// # Errors
    /// If a line is not understood, or one that is needed is missing; the sentence quotes it.
    pub fn read(bytes: &[u8]) -> Result<(Self, Input<'_>), String> {
        let mut rest = bytes;
        let mut format = None;
        // Old Macintosh programs end lines with a carriage return alone.
        let ends = match bytes {
            [_, _, _, b'\r', next, ..] if *next != b'\n' => b'\r',
            _ => b'\n',
        };
        let mut elements: Vec<Element> = Vec::new();
        for number in 1.. {
            let Some(end) = rest.iter().position(|b| *b == ends) else {
                return Err("the header has no end_header".into());
            };
            let line = String::from_utf8_lossy(&rest[..end]).into_owned();
            rest = &rest[end + 1..];
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            let understood = match words[..] {
                ["ply"] if number == 1 => true,
                _ if number == 1 => {
                    return Err("the file does not start with ply".into());
                }
                ["end_header"] => break,
                [] | ["comment" | "obj_info", ..] => true,
                ["format", kind, "1.0"] => {
                    format = match kind {
                        "ascii" => Some(Format::Ascii),
                        "binary_little_endian" => Some(Format::LittleEndian),
                        "binary_big_endian" => Some(Format::BigEndian),
                        _ => None,
                    };
                    format.is_some()
                }
                ["element", name, count] => count.parse().is_ok_and(|count| {
                    elements.push(Element {
                        name: name.into(),
                        count,
                        properties: Vec::new(),
                    });
                    true
                }),
                ["property", ..] => add_property(&words[1..], &mut elements).is_some(),
                _ => false,
            };
            if !understood {
                return Err(format!(
                    "line {number}: \"{}\" is not understood",
                    shown(line.trim())
                ));
            }
        }
        match format {
            Some(format) => Ok((Self { format, elements }, Input { rest, format })),
            None => Err("the header has no format".into()),
        }
    }
}

/// Adds the property that `words` describe to the last element.
fn add_property(words: &[&str], elements: &mut [Element]) -> Option<()> {
    let (length, kind, name) = match *words {
        ["list", length, kind, name] => (Some(Scalar::named(length)?), kind, name),
        [kind, name] => (None, kind, name),
        _ => return None,
    };
    elements.last_mut()?.properties.push(Property {
        name: name.into(),
        length,
        kind: Scalar::named(kind)?,
    });
    Some(())
}

/// The numbers behind the header.
#[derive(Clone, Debug)]
pub struct Input<'a> {
    rest: &'a [u8],
    format: Format,
}

impl Input<'_> {
    /// The next number, of type `kind` in a binary file.
    ///
    /// # Errors
    /// If there is none; the sentence says what is there.
    pub fn number(&mut self, kind: Scalar) -> Result<f64, String> {
        if let Format::Ascii = self.format {
            let text = self.rest.trim_ascii_start();
            let end = text.iter().position(u8::is_ascii_whitespace);
            let (word, rest) = text.split_at(end.unwrap_or(text.len()));
            self.rest = rest;
            let word = String::from_utf8_lossy(word);
            return match word.parse() {
                Ok(number) => Ok(number),
                Err(_) if word.is_empty() => Err("the file ends here".into()),
                Err(_) => Err(format!("\"{}\" is not a number", shown(&word))),
            };
        }
        Ok(match kind {
            Scalar::I8 => self.bytes(i8::from_be_bytes)?.into(),
            Scalar::U8 => self.bytes(u8::from_be_bytes)?.into(),
            Scalar::I16 => self.bytes(i16::from_be_bytes)?.into(),
            Scalar::U16 => self.bytes(u16::from_be_bytes)?.into(),
            Scalar::I32 => self.bytes(i32::from_be_bytes)?.into(),
            Scalar::U32 => self.bytes(u32::from_be_bytes)?.into(),
            Scalar::F32 => self.bytes(f32::from_be_bytes)?.into(),
            Scalar::F64 => self.bytes(f64::from_be_bytes)?,
        })
    }

    fn bytes<const N: usize, T>(&mut self, from: fn([u8; N]) -> T) -> Result<T, String> {
        let (bytes, rest) = self
            .rest
            .split_first_chunk::<N>()
            .ok_or("the file ends here")?;
        self.rest = rest;
        let mut bytes = *bytes;
        if let Format::LittleEndian = self.format {
            bytes.reverse();
        }
        Ok(from(bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_may_end_with_a_carriage_return_alone() {
        let text =
            "ply\rformat ascii 1.0\relement vertex 2\rproperty float x\rend_header\r1.5\r2.5\r";
        let (header, mut input) = Header::read(text.as_bytes()).unwrap();
        assert_eq!(header.elements[0].count, 2);
        let read = [(); 2].map(|()| input.number(Scalar::F32));
        assert_eq!(read, [Ok(1.5), Ok(2.5)]);
    }

    #[test]
    fn a_bad_line_or_word_is_quoted_in_one_short_line() {
        let (escapes, long) = ("\u{1b}[31m", "x".repeat(5000));
        let header = format!("ply\n{escapes}{long}\n");
        let message = Header::read(header.as_bytes()).unwrap_err();
        let start = "line 2: \"\\u{1b}[31mxxx";
        assert!(
            message.starts_with(start) && message.len() < 100,
            "{message}"
        );
        let text = format!("{escapes}{long} 1");
        let mut input = Input {
            rest: text.as_bytes(),
            format: Format::Ascii,
        };
        let message = input.number(Scalar::F32).unwrap_err();
        let start = "\"\\u{1b}[31mxxx";
        assert!(
            message.starts_with(start) && message.len() < 100,
            "{message}"
        );
    }
}
