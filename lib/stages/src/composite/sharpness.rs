//! What of the resolution only the preset tells.
use dipir_pipeline::config::Quality;
use dipir_render::adaptive::Stop;

use super::table::CompositeTable;
use crate::presets;

/// Whether the photograph's sharpness decides the resolution, where it does not as the other settings suggest: it does but with
/// those of the preset `high`. Unsaid elsewhere, so that composites stay current.
pub(super) fn odd_sharpness(table: &CompositeTable, quality: Quality) -> Option<bool> {
    let stop = table.stop(quality);
    let is_by_preset = table.most_pixels.is_none() && table.matches_blur();
    if !is_by_preset || matches!(stop, Stop::TimeBudget(_)) {
        return None;
    }
    let high = CompositeTable::default();
    let is_as_high = stop == high.stop(Quality::High)
        && table.denoise(quality) == high.denoise(Quality::High)
        && table.blur_caustics(quality) == high.blur_caustics(Quality::High);
    let follows = presets::of(quality).composite.follow_sharpness;
    (follows == is_as_high).then_some(follows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_preset_that_renders_other_pixels_alone_is_told_and_usual_ones_are_not() {
        let usual = CompositeTable::default();
        for quality in [Quality::Draft, Quality::Standard, Quality::High] {
            assert_eq!(odd_sharpness(&usual, quality), None);
        }
        let given = |target_error: f32, by_hand: bool| CompositeTable {
            target_error: Some(target_error),
            denoise: Some(by_hand),
            blur_caustics: Some(by_hand),
            ..CompositeTable::default()
        };
        // Nothing else tells these presets apart.
        for table in [given(0.004, true), given(0.001, false), given(0.01, true)] {
            let of = |quality| odd_sharpness(&table, quality);
            assert_ne!(of(Quality::Standard), of(Quality::High), "{table:?}");
        }
        // Where the preset does not count, they are one.
        let pixels = CompositeTable {
            most_pixels: Some(1000),
            ..given(0.004, true)
        };
        let sharp = CompositeTable {
            match_blur: Some(false),
            ..given(0.001, false)
        };
        for table in [pixels, sharp] {
            for quality in [Quality::Standard, Quality::High] {
                assert_eq!(odd_sharpness(&table, quality), None, "{table:?}");
            }
        }
    }
}
