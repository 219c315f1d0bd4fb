//! Fast elementary functions of latitude-longitude maps, in turns (1 turn = 2 pi).
use std::f32::consts::TAU;

/// Angle of `(x, y)` in turns, in `[0, 1)`, counted from +x towards +y; 0 at the origin.
#[inline]
pub(crate) fn atan2_turns(y: f32, x: f32) -> f32 {
    let t = y.atan2(x) / TAU;
    let t = if t < 0.0 { t + 1.0 } else { t };
    if t < 1.0 { t } else { 0.0 }
}

/// Sine and cosine of `turns * 2 pi`, for `turns` in `[0, 1]`.
#[inline]
pub(crate) fn sin_cos_turns(turns: f32) -> (f32, f32) {
    (turns * TAU).sin_cos()
}
