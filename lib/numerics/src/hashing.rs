//! Integer hashes that key the counter-based random numbers.

/// 2^64 over the golden ratio, odd: multiples of it are far apart [Steele et al. 2014].
pub const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// A 64-bit finaliser with full avalanche: every input bit flips every output bit with
/// probability near one half. A bijection [Steele et al. 2014, SplitMix64, "variant 13"].
#[inline]
pub fn mix64(mut x: u64) -> u64 {
    x ^= x >> 30;
    x = x.wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x ^= x >> 27;
    x = x.wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Folds any number of words into one hash; order matters.
#[inline]
pub fn hash_u64s(words: &[u64]) -> u64 {
    let mut h = GOLDEN;
    for &w in words {
        h = mix64(h ^ w).wrapping_add(GOLDEN);
    }
    h
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_input_bit_flips_about_half_of_the_output_bits() {
        // 64 x 256 trials of 64 bits each: the mean flip count has a standard error of
        // 4 / sqrt(16384) = 0.03 bits around 32.
        let mut total = 0u64;
        for i in 0..256u64 {
            for bit in 0..64 {
                total += (mix64(i) ^ mix64(i ^ (1 << bit))).count_ones() as u64;
            }
        }
        let mean = total as f64 / (64.0 * 256.0);
        assert!((mean - 32.0).abs() < 0.3, "mean flips {mean}");
    }

    #[test]
    fn order_of_words_matters() {
        assert_ne!(hash_u64s(&[1, 2]), hash_u64s(&[2, 1]));
        assert_ne!(hash_u64s(&[0]), hash_u64s(&[0, 0]));
    }
}
