//! Settings of the light that cost little.
use dipir_optimize::settings::LightPreset;

pub const PRESET: LightPreset = LightPreset {
    iterations: 4,
    lobes: 4,
    environment: [8, 4],
    samples: 4,
    size: 32,
};
