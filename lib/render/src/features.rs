//! Which feature masks the kernels are compiled for.
//!
//! Kernels take a mask of [`bsdf::features`](crate::bsdf::features) as `const F: u32`; code
//! behind a bit that is off is not compiled in. Compiling all combinations would cost hundreds
//! of kernels, so only the [`BUNDLES`] exist and a plan runs the cheapest one that has all it
//! needs.
pub use crate::bsdf::features::*;

/// Rays that leave the object and meet the proxy see the photograph instead of the light.
pub const PROXY_RADIANCE: u32 = 1 << 8;

/// Everything that a plan can ask for.
pub const EVERYTHING: u32 = ALL | PROXY_RADIANCE;

/// The masks that are compiled, cheapest first; the last is for scenes whose materials have
/// [`EXTENSIONS`], the one before it can do everything else, and the one before that everything
/// but [`SPECULAR`].
pub const BUNDLES: [u32; 7] = [
    0,
    SPECULAR,
    TEXTURES | EMISSION,
    SPECULAR | TEXTURES | NORMAL_MAPPING | EMISSION,
    EVERYTHING & !SPECULAR,
    EVERYTHING,
    EVERYTHING | EXTENSIONS,
];

/// The cheapest of [`BUNDLES`] that has all of `wanted`, without [`SPECULAR`] if that is not
/// wanted. Any other surplus bit is harmless: the surfaces were stripped of what is not wanted, so
/// the code behind the bit finds nothing to do.
pub(crate) fn bundle(wanted: u32) -> u32 {
    BUNDLES
        .into_iter()
        .find(|b| {
            b & wanted == wanted & (EVERYTHING | EXTENSIONS)
                && (b & SPECULAR) == (wanted & SPECULAR)
        })
        .unwrap_or(EVERYTHING | EXTENSIONS)
}

/// Evaluates `$body` with `$mask` bound to the compiled mask that [`bundle`] picks for
/// `$wanted`, as a constant.
macro_rules! with_features {
    ($wanted:expr, $mask:ident => $body:expr) => {{
        use $crate::features::{BUNDLES, bundle};
        let wanted = bundle($wanted);
        with_features!(@arms wanted, $mask, $body, 0 1 2 3 4 5)
    }};
    (@arms $wanted:ident, $mask:ident, $body:expr, $($i:literal)*) => {
        match $wanted {
            $(b if b == BUNDLES[$i] => {
                const $mask: u32 = BUNDLES[$i];
                $body
            })*
            _ => {
                const $mask: u32 = BUNDLES[6];
                $body
            }
        }
    };
}
pub(crate) use with_features;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bundle_has_all_that_is_wanted_and_no_unwanted_specular_lobe() {
        for wanted in 0..=EVERYTHING {
            // A reflection is what extensions extend.
            let wanted = match has(wanted, SPECULAR) {
                true => wanted,
                false => wanted & !EXTENSIONS,
            };
            let b = bundle(wanted);
            assert_eq!(b & wanted, wanted);
            assert_eq!(b & SPECULAR, wanted & SPECULAR);
            assert_eq!(with_features!(wanted, F => F), b);
        }
    }
}
