//! Eight `f32` at once: AVX2 where the target has it, arrays that compilers vectorise elsewhere.
//!
//! The two implementations differ in one thing: without FMA, `a b + c` rounds twice.

/// How many lanes there are.
pub const LANES: usize = 8;

/// Eight numbers in memory.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(32))]
pub struct Row(pub [f32; LANES]);

/// Eight integers in memory.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(32))]
pub struct Words(pub [u32; LANES]);

/// Asks for the cache lines of `items[index]` ahead of use, where the target knows how.
#[inline(always)]
pub fn prefetch<T>(items: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let start: *const i8 = items.as_ptr().wrapping_add(index).cast();
        for line in (0..size_of::<T>()).step_by(64) {
            // SAFETY: SSE is part of x86-64, and a prefetch of any address is harmless.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(start.wrapping_add(line)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (items, index);
}

#[cfg(all(
    target_arch = "x86_64",
    target_feature = "avx2",
    target_feature = "fma"
))]
mod imp {
    use super::{Row, Words};
    use std::arch::x86_64::*;
    use std::mem::MaybeUninit;

    /// Eight integers in a register.
    #[derive(Clone, Copy)]
    pub struct U32x8(__m256i);

    impl U32x8 {
        #[inline(always)]
        pub fn load(words: &Words) -> Self {
            // SAFETY: the module is compiled only where the target has AVX2 and FMA, which is
            // all that these intrinsics require; the reference is valid for 32 bytes and
            // `Words` is aligned to 32.
            Self(unsafe { _mm256_load_si256(words.0.as_ptr().cast()) })
        }
        /// Zero-extends the bytes of `x`, the lowest first.
        #[inline(always)]
        pub fn from_bytes(x: u64) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(x as i64)) })
        }
        /// The lanes that the low three bits of `lanes` name.
        #[inline(always)]
        pub fn select(self, lanes: U32x8) -> Self {
            // SAFETY: as above; the instruction ignores the other bits.
            Self(unsafe { _mm256_permutevar8x32_epi32(self.0, lanes.0) })
        }
        /// Writes all lanes.
        #[inline(always)]
        pub fn store_uninit(self, to: &mut [MaybeUninit<u32>; 8]) {
            // SAFETY: as above; the reference is valid for 32 bytes, no alignment is needed.
            unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), self.0) }
        }
        #[inline(always)]
        pub fn shift_right<const N: i32>(self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_srli_epi32::<N>(self.0) })
        }
    }

    /// Eight numbers in a register.
    #[derive(Clone, Copy)]
    pub struct F32x8(__m256);

    impl F32x8 {
        #[inline(always)]
        pub fn splat(x: f32) -> Self {
            // SAFETY: the module is compiled only where the target has AVX2 and FMA, which is
            // all that this and the following intrinsics require.
            Self(unsafe { _mm256_set1_ps(x) })
        }
        #[inline(always)]
        pub fn load(row: &Row) -> Self {
            // SAFETY: as above; the reference is valid for 32 bytes and `Row` is aligned to 32.
            Self(unsafe { _mm256_load_ps(row.0.as_ptr()) })
        }
        #[inline(always)]
        pub fn to_array(self) -> [f32; 8] {
            let mut row = Row([0.0; 8]);
            // SAFETY: as above.
            unsafe { _mm256_store_ps(row.0.as_mut_ptr(), self.0) };
            row.0
        }
        #[inline(always)]
        pub fn sub(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_sub_ps(self.0, b.0) })
        }
        #[inline(always)]
        pub fn mul(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_mul_ps(self.0, b.0) })
        }
        /// `self b - c`.
        #[inline(always)]
        pub fn mul_sub(self, b: Self, c: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_fmsub_ps(self.0, b.0, c.0) })
        }
        /// `c - self b`.
        #[inline(always)]
        pub fn mul_from(self, b: Self, c: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_fnmadd_ps(self.0, b.0, c.0) })
        }
        /// The larger, of its bits as integers: that of floats unless both are negative.
        #[inline(always)]
        pub fn max_bits(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe {
                _mm256_castsi256_ps(_mm256_max_epi32(
                    _mm256_castps_si256(self.0),
                    _mm256_castps_si256(b.0),
                ))
            })
        }
        /// The smaller, of its bits as integers: that of floats unless both are negative.
        #[inline(always)]
        pub fn min_bits(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe {
                _mm256_castsi256_ps(_mm256_min_epi32(
                    _mm256_castps_si256(self.0),
                    _mm256_castps_si256(b.0),
                ))
            })
        }
        /// The lanes that the low three bits of `lanes` name.
        #[inline(always)]
        pub fn select(self, lanes: U32x8) -> Self {
            // SAFETY: as above; the instruction ignores the other bits.
            Self(unsafe { _mm256_permutevar8x32_ps(self.0, lanes.0) })
        }
        /// All bits of a lane where `self > b`, of their bits as integers, else none.
        #[inline(always)]
        pub fn gt_bits(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe {
                _mm256_castsi256_ps(_mm256_cmpgt_epi32(
                    _mm256_castps_si256(self.0),
                    _mm256_castps_si256(b.0),
                ))
            })
        }
        /// The opposite sign.
        #[inline(always)]
        pub fn negate(self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_xor_ps(self.0, _mm256_set1_ps(-0.0)) })
        }
        /// Bits that both have.
        #[inline(always)]
        pub fn and(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_and_ps(self.0, b.0) })
        }
        /// Bits that either has.
        #[inline(always)]
        pub fn or(self, b: Self) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_or_ps(self.0, b.0) })
        }
        /// The numbers with the bits `b`.
        #[inline(always)]
        pub fn from_bits(b: U32x8) -> Self {
            // SAFETY: as above.
            Self(unsafe { _mm256_castsi256_ps(b.0) })
        }
        /// The sign bit of each lane.
        #[inline(always)]
        pub fn signs(self) -> u32 {
            // SAFETY: as above.
            unsafe { _mm256_movemask_ps(self.0) as u32 }
        }
    }
}

#[cfg(not(all(
    target_arch = "x86_64",
    target_feature = "avx2",
    target_feature = "fma"
)))]
mod imp {
    use super::{Row, Words};
    use std::array::from_fn;
    use std::mem::MaybeUninit;

    /// Eight integers.
    #[derive(Clone, Copy)]
    pub struct U32x8([u32; 8]);

    impl U32x8 {
        #[inline(always)]
        pub fn load(words: &Words) -> Self {
            Self(words.0)
        }
        /// Zero-extends the bytes of `x`, the lowest first.
        #[inline(always)]
        pub fn from_bytes(x: u64) -> Self {
            Self(x.to_le_bytes().map(u32::from))
        }
        /// The lanes that the low three bits of `lanes` name.
        #[inline(always)]
        pub fn select(self, lanes: U32x8) -> Self {
            Self(from_fn(|i| self.0[lanes.0[i] as usize & 7]))
        }
        /// Writes all lanes.
        #[inline(always)]
        pub fn store_uninit(self, to: &mut [MaybeUninit<u32>; 8]) {
            *to = self.0.map(MaybeUninit::new);
        }
        #[inline(always)]
        pub fn shift_right<const N: i32>(self) -> Self {
            Self(self.0.map(|x| x >> N))
        }
    }

    /// Eight numbers.
    #[derive(Clone, Copy)]
    pub struct F32x8([f32; 8]);

    impl F32x8 {
        #[inline(always)]
        fn zip(self, b: Self, f: impl Fn(f32, f32) -> f32) -> Self {
            Self(from_fn(|i| f(self.0[i], b.0[i])))
        }
        #[inline(always)]
        fn zip_bits(self, b: Self, f: impl Fn(i32, i32) -> i32) -> Self {
            self.zip(b, |a, b| {
                f32::from_bits(f(a.to_bits() as i32, b.to_bits() as i32) as u32)
            })
        }
        #[inline(always)]
        pub fn splat(x: f32) -> Self {
            Self([x; 8])
        }
        #[inline(always)]
        pub fn load(row: &Row) -> Self {
            Self(row.0)
        }
        #[inline(always)]
        pub fn to_array(self) -> [f32; 8] {
            self.0
        }
        #[inline(always)]
        pub fn sub(self, b: Self) -> Self {
            self.zip(b, |a, b| a - b)
        }
        #[inline(always)]
        pub fn mul(self, b: Self) -> Self {
            self.zip(b, |a, b| a * b)
        }
        /// `self b - c`.
        #[inline(always)]
        pub fn mul_sub(self, b: Self, c: Self) -> Self {
            self.mul(b).sub(c)
        }
        /// `c - self b`.
        #[inline(always)]
        pub fn mul_from(self, b: Self, c: Self) -> Self {
            c.sub(self.mul(b))
        }
        /// The larger, of its bits as integers: that of floats unless both are negative.
        #[inline(always)]
        pub fn max_bits(self, b: Self) -> Self {
            self.zip_bits(b, i32::max)
        }
        /// The smaller, of its bits as integers: that of floats unless both are negative.
        #[inline(always)]
        pub fn min_bits(self, b: Self) -> Self {
            self.zip_bits(b, i32::min)
        }
        /// The lanes that the low three bits of `lanes` name.
        #[inline(always)]
        pub fn select(self, lanes: U32x8) -> Self {
            Self(from_fn(|i| self.0[lanes.0[i] as usize & 7]))
        }
        /// All bits of a lane where `self > b`, of their bits as integers, else none.
        #[inline(always)]
        pub fn gt_bits(self, b: Self) -> Self {
            self.zip_bits(b, |a, b| -((a > b) as i32))
        }
        /// The opposite sign.
        #[inline(always)]
        pub fn negate(self) -> Self {
            Self(self.0.map(|x| -x))
        }
        /// Bits that both have.
        #[inline(always)]
        pub fn and(self, b: Self) -> Self {
            self.zip_bits(b, |a, b| a & b)
        }
        /// Bits that either has.
        #[inline(always)]
        pub fn or(self, b: Self) -> Self {
            self.zip_bits(b, |a, b| a | b)
        }
        /// The numbers with the bits `b`.
        #[inline(always)]
        pub fn from_bits(b: U32x8) -> Self {
            Self(b.0.map(f32::from_bits))
        }
        /// The sign bit of each lane.
        #[inline(always)]
        pub fn signs(self) -> u32 {
            (0..8).fold(0, |m, i| m | (self.0[i].to_bits() >> 31) << i)
        }
    }
}

pub use imp::{F32x8, U32x8};
