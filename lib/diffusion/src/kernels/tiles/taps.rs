//! Kernels apart by tap.

use super::micro::DEPTH;

/// Takes up to 32 kernels that follow one another apart by tap.
pub(super) struct Taps {
    taps: usize,
    #[cfg(target_arch = "x86_64")]
    chosen: Option<Box<nine::Chosen>>,
}

impl Taps {
    pub(super) fn new(taps: usize) -> Self {
        Self {
            taps,
            #[cfg(target_arch = "x86_64")]
            chosen: (taps == nine::TAPS && is_x86_feature_detected!("avx512bw"))
                .then(|| Box::new(nine::chosen())),
        }
    }

    /// Number i of `rows[tap]` is that of kernel i. What stands past the kernels of `source` in `rows` is unspecified.
    pub(super) fn split(&self, source: &[u16], rows: &mut [[u16; DEPTH]]) {
        assert!(source.len() <= DEPTH * self.taps && rows.len() == self.taps);
        #[cfg(target_arch = "x86_64")]
        if let Some(chosen) = &self.chosen {
            // SAFETY: `new` asked for the feature.
            return unsafe { nine::split(chosen, source, rows) };
        }
        for (tap, row) in rows.iter_mut().enumerate() {
            let values = source[tap.min(source.len())..].iter().step_by(self.taps);
            (row.iter_mut().zip(values)).for_each(|(row, &value)| *row = value);
        }
    }
}

/// Nine taps, by permutations of registers of 32 numbers.
#[cfg(target_arch = "x86_64")]
mod nine {
    use std::arch::x86_64::*;

    use super::DEPTH;

    pub(super) const TAPS: usize = 9;
    /// Pairs of registers that hold 32 kernels, the last one half filled.
    const PAIRS: usize = TAPS.div_ceil(2);

    /// Of each tap and each pair of registers: which of its 64 numbers goes where, and into which places any goes.
    pub(super) type Chosen = [[([u16; DEPTH], u32); PAIRS]; TAPS];

    pub(super) fn chosen() -> Chosen {
        std::array::from_fn(|tap| {
            std::array::from_fn(|pair| {
                let places: [usize; DEPTH] = std::array::from_fn(|kernel| kernel * TAPS + tap);
                let numbers = places.map(|place| (place % (2 * DEPTH)) as u16);
                let here = |kernel: &usize| places[*kernel] / (2 * DEPTH) == pair;
                let mask = (0..DEPTH)
                    .filter(here)
                    .fold(0, |mask, kernel| mask | 1 << kernel);
                (numbers, mask)
            })
        })
    }

    /// # Safety
    /// The processor has AVX-512 BW; `rows` are nine.
    #[target_feature(enable = "avx512f,avx512bw")]
    pub(super) unsafe fn split(chosen: &Chosen, source: &[u16], rows: &mut [[u16; DEPTH]]) {
        let load = |register: usize| {
            let left = source.len().saturating_sub(register * DEPTH).min(DEPTH);
            let mask = (1u64 << left) - 1;
            let start = source.as_ptr().wrapping_add(register * DEPTH).cast();
            // SAFETY: reads the numbers under the mask alone.
            unsafe { _mm512_maskz_loadu_epi16(mask as u32, start) }
        };
        let mut registers = [_mm512_setzero_si512(); 2 * PAIRS];
        for (index, register) in registers.iter_mut().enumerate().take(TAPS) {
            *register = load(index);
        }
        for (chosen, row) in chosen.iter().zip(rows) {
            let mut all = _mm512_setzero_si512();
            for (pair, (numbers, mask)) in chosen.iter().enumerate() {
                // SAFETY: 32 numbers.
                let numbers = unsafe { _mm512_loadu_epi16(numbers.as_ptr().cast()) };
                let (low, high) = (registers[2 * pair], registers[2 * pair + 1]);
                let some = _mm512_maskz_permutex2var_epi16(*mask, low, numbers, high);
                all = _mm512_or_si512(all, some);
            }
            // SAFETY: 32 numbers.
            unsafe { _mm512_storeu_epi16(row.as_mut_ptr().cast(), all) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_are_taken_apart_by_tap() {
        for taps in [1, 4, 9, 25] {
            for kernels in [1, 5, 16, 31, 32] {
                let source: Vec<u16> = (0..taps * kernels).map(|i| i as u16 + 1).collect();
                let mut rows = vec![[0; DEPTH]; taps];
                Taps::new(taps).split(&source, &mut rows);
                for (tap, row) in rows.iter().enumerate() {
                    let wanted = (0..kernels).map(|kernel| source[kernel * taps + tap]);
                    assert!(
                        row[..kernels].iter().copied().eq(wanted),
                        "{kernels} x {taps}"
                    );
                }
            }
        }
    }
}
