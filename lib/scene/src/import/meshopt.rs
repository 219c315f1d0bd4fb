//! `EXT_meshopt_compression`: the three bitstreams and the three filters of the extension.
//!
//! Every stream has a least length that follows from what it announces, which is checked before
//! memory is taken.

/// What a view says about its compressed bytes.
pub(super) struct Stream<'a> {
    pub bytes: &'a [u8],
    /// `ATTRIBUTES`, `TRIANGLES` or `INDICES`.
    pub mode: &'a str,
    /// `NONE`, `OCTAHEDRAL`, `QUATERNION` or `EXPONENTIAL`.
    pub filter: &'a str,
    pub count: usize,
    /// Bytes of an element.
    pub stride: usize,
}

/// The decoded view, or what is wrong with it.
pub(super) fn decode(stream: &Stream) -> Result<Vec<u8>, String> {
    let Stream {
        bytes,
        mode,
        filter,
        count,
        stride,
    } = *stream;
    match (mode, stride) {
        ("ATTRIBUTES", 4..=256) if stride.is_multiple_of(4) => {
            let mut decoded = attributes(bytes, count, stride)?;
            match (filter, stride) {
                ("NONE", _) => {}
                ("OCTAHEDRAL", 4) => octahedral_8(&mut decoded),
                ("OCTAHEDRAL", 8) => octahedral_16(&mut decoded),
                ("QUATERNION", 8) => quaternion(&mut decoded),
                ("EXPONENTIAL", _) => exponential(&mut decoded),
                _ => return Err(format!("the filter \"{filter}\" at a stride of {stride}")),
            }
            Ok(decoded)
        }
        ("TRIANGLES", 2 | 4) if count.is_multiple_of(3) && filter == "NONE" => {
            Ok(packed(triangles(bytes, count)?, stride))
        }
        ("INDICES", 2 | 4) if filter == "NONE" => Ok(packed(indices(bytes, count)?, stride)),
        _ => Err(format!(
            "the mode \"{mode}\" with {count} elements, a stride of {stride} and the filter \"{filter}\""
        )),
    }
}

const SHORT: &str = "a stream that is cut short";

/// Cuts the first `count` bytes off.
fn take<'a>(input: &mut &'a [u8], count: usize) -> Result<&'a [u8], String> {
    let (head, rest) = input.split_at_checked(count).ok_or(SHORT)?;
    *input = rest;
    Ok(head)
}

/// The bytes between the header and the tail, and the tail.
fn parts(bytes: &[u8], header: u8, tail: usize) -> Result<(&[u8], &[u8]), String> {
    match bytes.split_first() {
        Some((first, rest)) if *first == header => rest
            .len()
            .checked_sub(tail)
            .map(|middle| rest.split_at(middle))
            .ok_or_else(|| SHORT.into()),
        Some((first, _)) => Err(format!("a stream that starts with {first}, not {header}")),
        None => Err(SHORT.into()),
    }
}

fn all_read(input: &[u8]) -> Result<(), String> {
    match input.len() {
        0 => Ok(()),
        n => Err(format!("{n} bytes behind what was announced")),
    }
}

fn attributes(bytes: &[u8], count: usize, stride: usize) -> Result<Vec<u8>, String> {
    let (mut input, tail) = parts(bytes, 0xa0, stride.max(32))?;
    // Two bits at the least for a byte of sixteen elements.
    if input.len() / stride < count.div_ceil(64) {
        return Err(SHORT.into());
    }
    let mut previous = tail[tail.len() - stride..].to_vec();
    let mut out = vec![0; count * stride];
    let block_elements = ((8192 / stride) & !15).min(256);
    for block in out.chunks_mut(block_elements * stride) {
        let elements = block.len() / stride;
        let groups = elements.div_ceil(16);
        for k in 0..stride {
            let header = take(&mut input, groups.div_ceil(4))?;
            let mut value = previous[k];
            for g in 0..groups {
                let deltas = group(header[g / 4] >> (2 * (g % 4)) & 3, &mut input)?;
                let here = elements - 16 * g;
                for (i, delta) in deltas.into_iter().enumerate().take(here) {
                    value = value.wrapping_add(delta >> 1 ^ (delta & 1).wrapping_neg());
                    block[(16 * g + i) * stride + k] = value;
                }
            }
        }
        previous.copy_from_slice(&block[block.len() - stride..]);
    }
    all_read(input)?;
    Ok(out)
}

/// Sixteen deltas, in the code that their two header bits name.
fn group(code: u8, input: &mut &[u8]) -> Result<[u8; 16], String> {
    let mut deltas = [0; 16];
    let bits = match code {
        0 => return Ok(deltas),
        1 => 2,
        2 => 4,
        _ => {
            deltas.copy_from_slice(take(input, 16)?);
            return Ok(deltas);
        }
    };
    let short = take(input, 2 * bits)?;
    let per_byte = 8 / bits;
    let all_ones = (1u8 << bits) - 1;
    for (i, delta) in deltas.iter_mut().enumerate() {
        let shift = 8 - bits * (i % per_byte + 1);
        *delta = short[i / per_byte] >> shift & all_ones;
        if *delta == all_ones {
            *delta = take(input, 1)?[0];
        }
    }
    Ok(deltas)
}

/// An unsigned integer of seven bits a byte.
fn varint(input: &mut &[u8]) -> Result<u32, String> {
    let mut value = 0;
    for shift in [0, 7, 14, 21, 28] {
        let byte = take(input, 1)?[0];
        value |= u32::from(byte & 127) << shift;
        if byte < 128 {
            break;
        }
    }
    Ok(value)
}

fn zigzag(value: u32) -> u32 {
    value >> 1 ^ (value & 1).wrapping_neg()
}

/// The last sixteen of what was pushed, 0 the latest.
struct Fifo<T> {
    entries: [T; 16],
    next: usize,
}

impl<T: Copy + Default> Fifo<T> {
    fn new() -> Self {
        Self {
            entries: [T::default(); 16],
            next: 0,
        }
    }

    fn push(&mut self, entry: T) {
        self.entries[self.next & 15] = entry;
        self.next += 1;
    }

    fn get(&self, back: usize) -> T {
        self.entries[self.next.wrapping_sub(1 + back) & 15]
    }
}

struct TriangleDecoder<'a> {
    input: &'a [u8],
    next: u32,
    last: u32,
    edges: Fifo<(u32, u32)>,
    vertices: Fifo<u32>,
}

impl TriangleDecoder<'_> {
    fn fresh(&mut self) -> u32 {
        self.next = self.next.wrapping_add(1);
        self.next.wrapping_sub(1)
    }

    fn explicit(&mut self) -> Result<u32, String> {
        self.last = self.last.wrapping_add(zigzag(varint(&mut self.input)?));
        Ok(self.last)
    }

    fn triangle(&mut self, code: u8, table: &[u8]) -> Result<[u32; 3], String> {
        match code >> 4 {
            15 => self.apart(code, table),
            edge => self.beside(edge, code & 15),
        }
    }

    /// A triangle at an edge of an earlier one.
    fn beside(&mut self, edge: u8, third: u8) -> Result<[u32; 3], String> {
        let (a, b) = self.edges.get(edge.into());
        let c = match third {
            0 => self.fresh(),
            1..13 => self.vertices.get(third.into()),
            13 => {
                self.last = self.last.wrapping_sub(1);
                self.last
            }
            14 => {
                self.last = self.last.wrapping_add(1);
                self.last
            }
            _ => self.explicit()?,
        };
        self.edges.push((c, b));
        self.edges.push((a, c));
        if !(1..13).contains(&third) {
            self.vertices.push(c);
        }
        Ok([a, b, c])
    }

    /// A triangle of its own.
    fn apart(&mut self, code: u8, table: &[u8]) -> Result<[u32; 3], String> {
        let kinds = match code & 15 {
            at @ 0..14 => table[usize::from(at)],
            _ => take(&mut self.input, 1)?[0],
        };
        if code >= 0xfe && kinds == 0 {
            self.next = 0;
        }
        let a = match code {
            0xff => None,
            _ => Some(self.fresh()),
        };
        // Vertices of the list are read before those that are spelt out.
        let mut corner = |kind: u8| match kind {
            0 => Some(self.fresh()),
            15 if code >= 0xfe => None,
            back => Some(self.vertices.get(usize::from(back) - 1)),
        };
        let (b, c) = (corner(kinds >> 4), corner(kinds & 15));
        let a = a.map_or_else(|| self.explicit(), Ok)?;
        let b = b.map_or_else(|| self.explicit(), Ok)?;
        let c = c.map_or_else(|| self.explicit(), Ok)?;
        self.edges.push((b, a));
        self.edges.push((c, b));
        self.edges.push((a, c));
        self.vertices.push(a);
        for (kind, vertex) in [(kinds >> 4, b), (kinds & 15, c)] {
            if kind == 0 || (kind == 15 && code >= 0xfe) {
                self.vertices.push(vertex);
            }
        }
        Ok([a, b, c])
    }
}

fn triangles(bytes: &[u8], count: usize) -> Result<Vec<u32>, String> {
    let (middle, table) = parts(bytes, 0xe1, 16)?;
    let (codes, input) = middle.split_at_checked(count / 3).ok_or(SHORT)?;
    let mut decoder = TriangleDecoder {
        input,
        next: 0,
        last: 0,
        edges: Fifo::new(),
        vertices: Fifo::new(),
    };
    let mut out = Vec::with_capacity(count);
    for &code in codes {
        out.extend(decoder.triangle(code, table)?);
    }
    all_read(decoder.input)?;
    Ok(out)
}

fn indices(bytes: &[u8], count: usize) -> Result<Vec<u32>, String> {
    let (mut input, _) = parts(bytes, 0xd1, 4)?;
    if input.len() < count {
        return Err(SHORT.into());
    }
    let mut last = [0u32; 2];
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let value = varint(&mut input)?;
        let baseline = &mut last[(value & 1) as usize];
        *baseline = baseline.wrapping_add(zigzag(value >> 1));
        out.push(*baseline);
    }
    all_read(input)?;
    Ok(out)
}

/// Indices as `stride` bytes each.
fn packed(indices: Vec<u32>, stride: usize) -> Vec<u8> {
    let bytes = indices.iter().map(|i| i.to_le_bytes());
    bytes.flat_map(|b| b.into_iter().take(stride)).collect()
}

/// The unit vector of two octahedral coordinates.
fn octahedral(x: f32, y: f32, one: f32) -> [f32; 3] {
    let (x, y) = (x / one, y / one);
    let z = 1.0 - x.abs() - y.abs();
    let below = z.min(0.0);
    let (x, y) = (x - below.copysign(x), y - below.copysign(y));
    let length = (x * x + y * y + z * z).sqrt();
    [x / length, y / length, z / length]
}

fn octahedral_8(data: &mut [u8]) {
    for v in data.as_chunks_mut::<4>().0 {
        let [x, y, one] = [0, 1, 2].map(|k| f32::from(v[k] as i8));
        for (out, c) in v.iter_mut().zip(octahedral(x, y, one)) {
            *out = (c * 127.0).round() as i8 as u8;
        }
    }
}

fn octahedral_16(data: &mut [u8]) {
    for v in data.as_chunks_mut::<8>().0 {
        let [x, y, one] =
            [0, 1, 2].map(|k| f32::from(i16::from_le_bytes([v[2 * k], v[2 * k + 1]])));
        for (out, c) in v
            .as_chunks_mut::<2>()
            .0
            .iter_mut()
            .zip(octahedral(x, y, one))
        {
            *out = ((c * 32767.0).round() as i16).to_le_bytes();
        }
    }
}

fn quaternion(data: &mut [u8]) {
    for v in data.as_chunks_mut::<8>().0 {
        let word = |k: usize| i16::from_le_bytes([v[2 * k], v[2 * k + 1]]);
        // The last word holds the scale, and in its lowest bits which component was dropped.
        let last = word(3);
        let scale = std::f32::consts::FRAC_1_SQRT_2 / f32::from(last | 3);
        let [x, y, z] = [0, 1, 2].map(|k| f32::from(word(k)) * scale);
        let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
        for (offset, c) in [(1, x), (2, y), (3, z), (0, w)] {
            let at = 2 * (((last & 3) as usize + offset) & 3);
            let word = (c * 32767.0).round() as i16;
            v[at..at + 2].copy_from_slice(&word.to_le_bytes());
        }
    }
}

fn exponential(data: &mut [u8]) {
    for v in data.as_chunks_mut::<4>().0 {
        let word = i32::from_le_bytes(*v);
        let (exponent, mantissa) = (word >> 24, word << 8 >> 8);
        // By way of double precision: 2^-128 alone is no normal single.
        let value = f64::from(mantissa) * f64::from(exponent).exp2();
        *v = (value as f32).to_le_bytes();
    }
}

#[cfg(test)]
mod tests;
