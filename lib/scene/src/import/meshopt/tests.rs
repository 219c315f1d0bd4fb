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
