//! 32 x 32 sums over a depth of packed bf16, by the instructions that the processor has.

use crate::kernels::simd::vectorized;

/// Rows of a tile.
pub(super) const ROWS: usize = 16;
/// Elements of depth of a tile.
pub(super) const DEPTH: usize = 32;
/// Rows and columns of a block of sums: two by two tiles.
pub(super) const SIDE: usize = 32;

/// What multiplies bf16 faster than f32 on this processor, in words; `None` where nothing does, or the system does not let it
/// be used. AVX-512's dot products of bf16 do not: they save half of the products, Winograd's convolutions in f32 more.
pub fn bf16_products() -> Option<&'static str> {
    match kind() {
        Kind::Tiles => Some("tiles of AMX"),
        Kind::Plain => None,
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// AMX: a tile of 16 rows times a tile of 16 columns, 32 deep, an instruction.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
    Tiles,
    /// Products in f32: runs everywhere, slower than the kernels for f32.
    Plain,
}

fn kind() -> Kind {
    static KIND: std::sync::OnceLock<Kind> = std::sync::OnceLock::new();
    *KIND.get_or_init(|| kinds()[0])
}

/// Those that can run here, the fastest first.
pub(super) fn kinds() -> Vec<Kind> {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") && amx::available() {
        return vec![Kind::Tiles, Kind::Plain];
    }
    vec![Kind::Plain]
}

/// This thread's right to multiply, until it is dropped.
pub(super) struct Instructions(Kind);

impl Instructions {
    pub(super) fn start() -> Self {
        Self::of(kind())
    }

    pub(super) fn of(kind: Kind) -> Self {
        #[cfg(target_arch = "x86_64")]
        if kind == Kind::Tiles {
            amx::configure();
        }
        Self(kind)
    }

    /// Adds the products of two tiles of rows and 32 columns over `steps` to `sums`, or starts them anew.
    ///
    /// # Safety
    /// `a` are the first tiles of two blocks of rows, whose tiles follow one another; `b` is valid for reads of 16 rows of
    /// 32 words, `stride` apart, at each of `steps`.
    pub(super) unsafe fn multiply(
        &self,
        a: [*const u16; 2],
        b: *const u32,
        steps: &[usize],
        stride: usize,
        sums: &mut [f32; SIDE * SIDE],
        anew: bool,
    ) {
        // SAFETY: by the caller's contract; `of` was given what the processor has.
        unsafe {
            match self.0 {
                #[cfg(target_arch = "x86_64")]
                Kind::Tiles => amx::multiply(a, b, steps, stride, sums, anew),
                _ => plain_tiles(a, b, steps, stride, sums, anew),
            }
        }
    }
}

/// # Safety
/// As [`Instructions::multiply`].
unsafe fn plain_tiles(
    a: [*const u16; 2],
    b: *const u32,
    steps: &[usize],
    stride: usize,
    sums: &mut [f32; SIDE * SIDE],
    anew: bool,
) {
    if anew {
        sums.fill(0.0);
    }
    for (step, &at) in steps.iter().enumerate() {
        // SAFETY: by the caller's contract.
        let (words, tiles) = unsafe {
            let words = std::slice::from_raw_parts(b.add(at), (DEPTH / 2 - 1) * stride + SIDE);
            let tile = |a: *const u16| {
                std::slice::from_raw_parts(a.add(step * ROWS * DEPTH), ROWS * DEPTH)
            };
            (words, a.map(tile))
        };
        for (tile, sums) in tiles.into_iter().zip(sums.chunks_exact_mut(ROWS * SIDE)) {
            plain(tile, words, stride, sums);
        }
    }
}

/// Rows whose sums stay in registers.
const GROUP: usize = 4;

vectorized! {
    /// Adds the product of a tile of rows and 32 columns.
    fn plain(tile: &[u16], words: &[u32], stride: usize, sums: &mut [f32]) {
        let groups = tile.chunks_exact(GROUP * DEPTH).zip(sums.chunks_exact_mut(GROUP * SIDE));
        for (rows, sums) in groups {
            let mut kept = [[0f32; SIDE]; GROUP];
            for (kept, sums) in kept.iter_mut().zip(sums.chunks_exact(SIDE)) {
                kept.copy_from_slice(sums);
            }
            for pair in 0..DEPTH / 2 {
                let words = &words[pair * stride..][..SIDE];
                for (row, kept) in kept.iter_mut().enumerate() {
                    let at = row * DEPTH + 2 * pair;
                    let low = f32::from_bits((rows[at] as u32) << 16);
                    let high = f32::from_bits((rows[at + 1] as u32) << 16);
                    for j in 0..SIDE {
                        let sum = low.mul_add(f32::from_bits(words[j] << 16), kept[j]);
                        kept[j] = high.mul_add(f32::from_bits(words[j] & 0xffff_0000), sum);
                    }
                }
            }
            for (kept, sums) in kept.iter().zip(sums.chunks_exact_mut(SIDE)) {
                sums.copy_from_slice(kept);
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
impl Drop for Instructions {
    fn drop(&mut self) {
        if self.0 == Kind::Tiles {
            amx::release();
        }
    }
}

/// The instructions are written out: the compiler's own functions for them are not stable.
#[cfg(target_arch = "x86_64")]
mod amx {
    use std::arch::asm;
    use std::arch::x86_64::{__cpuid, __cpuid_count};

    use super::{DEPTH, ROWS, SIDE};

    /// Whether the processor has tiles of bf16 and the system saves them for this process.
    pub(super) fn available() -> bool {
        const TILES_AND_BF16: u32 = 1 << 24 | 1 << 22;
        let known =
            __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & TILES_AND_BF16 == TILES_AND_BF16;
        known && permitted()
    }

    /// Linux wants to be asked before the first use.
    #[cfg(target_os = "linux")]
    fn permitted() -> bool {
        const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
        const TILE_DATA: libc::c_long = 18;
        // SAFETY: the call changes nothing but what the process may use.
        unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, TILE_DATA) == 0 }
    }

    #[cfg(not(target_os = "linux"))]
    fn permitted() -> bool {
        false
    }

    /// Eight tiles of 16 rows of 64 bytes.
    pub(super) fn configure() {
        #[repr(C, align(64))]
        struct Configuration([u8; 64]);
        let mut tiles = Configuration([0; 64]);
        tiles.0[0] = 1;
        for tile in 0..8 {
            tiles.0[16 + 2 * tile] = 64;
            tiles.0[48 + tile] = ROWS as u8;
        }
        // SAFETY: `Instructions` has asked for the feature; compiled code uses no tiles of its own.
        unsafe { asm!("ldtilecfg [{}]", in(reg) tiles.0.as_ptr(), options(nostack, readonly)) };
    }

    pub(super) fn release() {
        // SAFETY: as above.
        unsafe { asm!("tilerelease", options(nostack, nomem)) };
    }

    /// # Safety
    /// As [`super::Instructions::multiply`]; the tiles are configured.
    pub(super) unsafe fn multiply(
        a: [*const u16; 2],
        b: *const u32,
        steps: &[usize],
        stride: usize,
        sums: &mut [f32; SIDE * SIDE],
        anew: bool,
    ) {
        const LINE: usize = 64;
        let sums = sums.as_mut_ptr();
        let corners =
            [0, SIDE / 2, ROWS * SIDE, ROWS * SIDE + SIDE / 2].map(|at| sums.wrapping_add(at));
        // SAFETY: reads and writes the sums, the tiles of A and the words of B that the caller vouches for.
        unsafe {
            if anew {
                asm!(
                    "tilezero tmm0",
                    "tilezero tmm1",
                    "tilezero tmm2",
                    "tilezero tmm3",
                    options(nostack, nomem)
                );
            } else {
                asm!(
                    "tileloadd tmm0, [{0} + {4}*1]",
                    "tileloadd tmm1, [{1} + {4}*1]",
                    "tileloadd tmm2, [{2} + {4}*1]",
                    "tileloadd tmm3, [{3} + {4}*1]",
                    in(reg) corners[0],
                    in(reg) corners[1],
                    in(reg) corners[2],
                    in(reg) corners[3],
                    in(reg) SIDE * 4,
                    options(nostack, readonly)
                );
            }
            for (step, &at) in steps.iter().enumerate() {
                let words = b.add(at);
                // Rows are read once and columns again: T1 leaves L1 to the columns.
                asm!(
                    "tileloaddt1 tmm4, [{a0} + {line}*1]",
                    "tileloadd tmm6, [{b} + {stride}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tileloadd tmm7, [{b} + {stride}*1 + 64]",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tileloaddt1 tmm5, [{a1} + {line}*1]",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    a0 = in(reg) a[0].add(step * ROWS * DEPTH),
                    a1 = in(reg) a[1].add(step * ROWS * DEPTH),
                    b = in(reg) words,
                    line = in(reg) LINE,
                    stride = in(reg) stride * 4,
                    options(nostack, readonly)
                );
            }
            asm!(
                "tilestored [{0} + {4}*1], tmm0",
                "tilestored [{1} + {4}*1], tmm1",
                "tilestored [{2} + {4}*1], tmm2",
                "tilestored [{3} + {4}*1], tmm3",
                in(reg) corners[0],
                in(reg) corners[1],
                in(reg) corners[2],
                in(reg) corners[3],
                in(reg) SIDE * 4,
                options(nostack)
            );
        }
    }
}
