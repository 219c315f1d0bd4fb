//! What an independent encoder wrote is read back, and the filters meet closed forms.
use super::*;

/// A stream of numbers (SplitMix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }
}

fn decoded(bytes: &[u8], mode: &str, count: usize, stride: usize) -> Result<Vec<u8>, String> {
    decode(&Stream {
        bytes,
        mode,
        filter: "NONE",
        count,
        stride,
    })
}

/// Elements of `N` bytes as the other encoder writes them.
fn encoded<const N: usize>(elements: &[[u8; N]]) -> Vec<u8> {
    use meshopt_rs::vertex::VertexEncodingVersion::V0;
    use meshopt_rs::vertex::buffer::{encode_vertex_buffer, encode_vertex_buffer_bound};
    let mut buffer = vec![0; encode_vertex_buffer_bound(elements.len(), N)];
    let size = encode_vertex_buffer(&mut buffer, elements, V0).unwrap();
    buffer.truncate(size);
    buffer
}

fn attributes_survive<const N: usize>(count: usize, spread: u64) {
    let mut random = Random(count as u64 + spread);
    let mut current = [0u8; N];
    let elements: Vec<[u8; N]> = (0..count)
        .map(|_| {
            for byte in &mut current {
                *byte = byte.wrapping_add((random.next() % spread) as u8);
            }
            current
        })
        .collect();
    let bytes = encoded(&elements);
    let found = decoded(&bytes, "ATTRIBUTES", count, N).unwrap();
    assert_eq!(
        found,
        elements.as_flattened(),
        "{count} of {N} bytes, {spread}"
    );
}

#[test]
fn attributes_of_another_encoder_are_read_back() {
    // Around the lengths of groups (16) and blocks (256, and 8192 bytes); steps that take none, two,
    // four and eight bits.
    for spread in [1, 2, 6, 256] {
        for count in [1, 15, 16, 17, 255, 256, 257, 1000] {
            attributes_survive::<4>(count, spread);
            attributes_survive::<12>(count, spread);
            attributes_survive::<64>(count, spread);
            attributes_survive::<256>(count, spread);
        }
    }
}

/// Two triangles for each cell of a grid, and some at random.
fn mesh_indices(n: u32, random: u32) -> Vec<u32> {
    let mut all = Vec::new();
    for y in 0..n {
        for x in 0..n {
            let a = y * (n + 1) + x;
            all.extend([a, a + 1, a + n + 1, a + n + 1, a + 1, a + n + 2]);
        }
    }
    let mut numbers = Random(7);
    let count = u64::from((n + 1) * (n + 1));
    all.extend((0..3 * random).map(|_| (numbers.next() % count) as u32));
    all
}

#[test]
fn triangles_of_another_encoder_are_read_back_up_to_the_turn_of_each() {
    use meshopt_rs::index::IndexEncodingVersion::V1;
    use meshopt_rs::index::buffer::{encode_index_buffer, encode_index_buffer_bound};
    for (n, random) in [(1, 0), (20, 0), (20, 500), (3, 2000)] {
        let indices = mesh_indices(n, random);
        let bound = encode_index_buffer_bound(indices.len(), ((n + 1) * (n + 1)) as usize);
        let mut bytes = vec![0; bound];
        let size = encode_index_buffer(&mut bytes, &indices, V1).unwrap();
        bytes.truncate(size);
        // The encoder turns triangles so that a shared edge comes first.
        let least = |t: &[u32]| {
            [[t[0], t[1], t[2]], [t[1], t[2], t[0]], [t[2], t[0], t[1]]]
                .into_iter()
                .min()
        };
        let expected: Vec<_> = indices.chunks(3).map(least).collect();
        let wide = decoded(&bytes, "TRIANGLES", indices.len(), 4).unwrap();
        let found: Vec<u32> = wide
            .as_chunks()
            .0
            .iter()
            .map(|b| u32::from_le_bytes(*b))
            .collect();
        assert_eq!(found.chunks(3).map(least).collect::<Vec<_>>(), expected);
        let narrow = decoded(&bytes, "TRIANGLES", indices.len(), 2).unwrap();
        let narrow = narrow
            .as_chunks()
            .0
            .iter()
            .map(|b| u32::from(u16::from_le_bytes(*b)));
        assert!(narrow.eq(found));
    }
}

#[test]
fn index_sequences_of_another_encoder_are_read_back() {
    use meshopt_rs::index::IndexEncodingVersion::V1;
    use meshopt_rs::index::sequence::{encode_index_sequence, encode_index_sequence_bound};
    let indices = mesh_indices(20, 500);
    let mut bytes = vec![0; encode_index_sequence_bound(indices.len(), 441)];
    let size = encode_index_sequence(&mut bytes, &indices, V1);
    bytes.truncate(size);
    let found = decoded(&bytes, "INDICES", indices.len(), 4).unwrap();
    let found: Vec<u32> = found
        .as_chunks()
        .0
        .iter()
        .map(|b| u32::from_le_bytes(*b))
        .collect();
    assert_eq!(found, indices);
}

#[test]
fn the_example_of_the_extension_is_read() {
    let mut input = &[0x17, 0x5f, 0xf0, 0xbc, 0x77, 0xa9, 0x21, 0x00, 0x34, 0xb5][..];
    let deltas = group(2, &mut input).unwrap();
    let signed = deltas.map(|d| (d >> 1 ^ (d & 1).wrapping_neg()) as i8);
    assert_eq!(
        signed,
        [-1, -4, -3, 26, -91, 0, -6, 6, -4, -4, 5, -5, 1, -1, 0, 0]
    );
    assert!(input.is_empty());
}

#[test]
fn filters_give_unit_vectors_rotations_and_powers_of_two() {
    // Of ten bits: 511 is one. The pole, an axis, and a point below the equator.
    let vector = |x: i16, y: i16| {
        let mut bytes: Vec<u8> = [x, y, 511, 7]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        octahedral_16(&mut bytes);
        let words = bytes.as_chunks().0.iter().map(|b| i16::from_le_bytes(*b));
        words.collect::<Vec<_>>()
    };
    assert_eq!(vector(0, 0), [0, 0, 32767, 7]);
    assert_eq!(vector(511, 0), [32767, 0, 0, 7]);
    // |x| + |y| = 2 means the lower pole.
    assert_eq!(vector(511, 511), [0, 0, -32767, 7]);
    let mut small = [127u8, 0, 127, 9];
    octahedral_8(&mut small);
    assert_eq!(small, [127, 0, 0, 9]);

    // A rotation by nothing: the fourth component was the largest.
    let mut bytes: Vec<u8> = [0i16, 0, 0, 2047]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    quaternion(&mut bytes);
    let words: Vec<i16> = bytes
        .as_chunks()
        .0
        .iter()
        .map(|b| i16::from_le_bytes(*b))
        .collect();
    assert_eq!(words, [0, 0, 0, 32767]);

    let number = |exponent: i32, mantissa: i32| {
        let mut bytes = (exponent << 24 | mantissa & 0xff_ffff).to_le_bytes();
        exponential(&mut bytes);
        f32::from_le_bytes(bytes)
    };
    assert_eq!(number(-4, 3), 3.0 / 16.0);
    assert_eq!(number(100, -5), -5.0 * 2f32.powi(100));
    // A number below the normal ones.
    assert_eq!(number(-128, 1), f32::MIN_POSITIVE / 4.0);
}

#[test]
fn damaged_streams_end_in_an_error_or_in_values_and_take_no_memory_first() {
    let elements: Vec<[u8; 12]> = (0..300u32).map(|i| [i as u8; 12]).collect();
    let whole = encoded(&elements);
    for end in 0..whole.len() {
        assert!(decoded(&whole[..end], "ATTRIBUTES", 300, 12).is_err());
    }
    for mode in ["ATTRIBUTES", "TRIANGLES", "INDICES"] {
        let header = match mode {
            "ATTRIBUTES" => 0xa0,
            "TRIANGLES" => 0xe1,
            _ => 0xd1,
        };
        // What is announced would be 36 GB.
        let short = decoded(&[header; 64], mode, 9_000_000_000, 4);
        assert_eq!(short.unwrap_err(), SHORT);
        let mut random = Random(3);
        for _ in 0..2000 {
            let mut bytes: Vec<u8> = (0..200).map(|_| random.next() as u8).collect();
            bytes[0] = header;
            let _ = decoded(&bytes, mode, 96, 4);
        }
    }
}
