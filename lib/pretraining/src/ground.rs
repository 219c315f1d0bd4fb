//! The ground of generated scenes: a pattern of two colours, and wear.

use glam::{Vec2, Vec3};

use crate::random::Draw;
use crate::scene::Setting;

/// The pattern of albedo of a ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ground {
    colors: [Vec3; 2],
    pattern: Pattern,
    scale: f32,
    turn: Vec2,
    seed: u32,
    wear: Wear,
}

/// Wear of a ground, as changes of its albedo.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Wear {
    /// Strength of fine mottling, 0 to 1.
    grain: f32,
    /// Share of the albedo that dark patches with clear edges lack.
    stains: f32,
    /// Contrast between the two sides of a line, from 0 to 1. At 1 the darker side has .4 of the other's albedo.
    kerb: f32,
    /// Distance of that line from the origin, metres.
    offset: f32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Pattern {
    Plain,
    Checkers,
    Stripes,
    Noise,
    Tiles,
}

impl Draw<'_> {
    /// A ground for `setting`.
    pub(crate) fn ground(&mut self, setting: Setting) -> Ground {
        let hue = Vec3::new(
            self.range(0.6, 1.0),
            self.range(0.6, 1.0),
            self.range(0.55, 1.0),
        );
        let base = hue * self.range(0.1, 0.62);
        let other = base * self.range(0.45, 1.55)
            + Vec3::new(
                self.range(-0.04, 0.04),
                self.range(-0.04, 0.04),
                self.range(-0.04, 0.04),
            );
        let pattern = match self.range(0.0, 1.0) {
            x if x < 0.4 && setting != Setting::Open => Pattern::Tiles,
            x if x < 0.25 => Pattern::Plain,
            x if x < 0.37 => Pattern::Checkers,
            x if x < 0.49 => Pattern::Stripes,
            _ => Pattern::Noise,
        };
        let scale = if pattern == Pattern::Noise {
            self.range(0.5, 5.0)
        } else {
            self.range(0.5, 2.2)
        };
        let (s, c) = self.range(0.0, std::f32::consts::PI).sin_cos();
        Ground {
            colors: [base, other.clamp(Vec3::splat(0.03), Vec3::splat(0.9))],
            pattern,
            scale,
            turn: Vec2::new(c, s),
            seed: self.below(1 << 20) as u32,
            wear: match setting {
                Setting::Open | Setting::Street => Wear::default(),
                Setting::Courtyard => self.wear(),
            },
        }
    }

    fn wear(&mut self) -> Wear {
        let mut one_in_two = |high: f32| match self.chance(0.5) {
            true => self.range(0.0, high),
            false => 0.0,
        };
        Wear {
            grain: one_in_two(0.7),
            stains: one_in_two(0.6),
            kerb: one_in_two(1.0),
            offset: self.range(-3.0, 3.0),
        }
    }
}

impl Ground {
    /// Linear albedo at (x, z), metres.
    pub fn albedo(&self, at: Vec2) -> Vec3 {
        (self.pattern_at(at) * self.wear_at(at)).min(Vec3::splat(0.9))
    }

    fn wear_at(&self, at: Vec2) -> f32 {
        let wear = &self.wear;
        if *wear == Wear::default() {
            return 1.0;
        }
        let fine = value_noise(at * 9.0, self.seed ^ 7) + value_noise(at * 23.0, self.seed ^ 8);
        let mut factor = 1.0 + wear.grain * 0.5 * (fine - 1.0);
        let blot = 0.7 * value_noise(at * 0.9, self.seed ^ 9)
            + 0.3 * value_noise(at * 4.0, self.seed ^ 10);
        if blot > 0.62 {
            factor *= 1.0 - wear.stains;
        }
        if self.turn.perp_dot(at) > wear.offset {
            factor *= 1.0 - 0.6 * wear.kerb;
        }
        factor
    }

    fn pattern_at(&self, at: Vec2) -> Vec3 {
        let p = Vec2::new(self.turn.dot(at), self.turn.perp_dot(at)) * self.scale;
        let odd = |x: f32| (x.floor() as i64).rem_euclid(2) as f32;
        let mix = match self.pattern {
            Pattern::Plain => 0.0,
            Pattern::Checkers => (odd(p.x) - odd(p.y)).abs(),
            Pattern::Stripes => odd(p.x),
            Pattern::Tiles => {
                // Every other row is shifted by half a tile; joints are dark.
                let row = (2.0 * p.y).floor();
                let along = p.x + 0.5 * odd(row);
                let (across, within) = (2.0 * p.y - row, along - along.floor());
                if across < 0.1 || within < 0.05 {
                    return self.colors[0].min(self.colors[1]) * 0.4;
                }
                value_noise(Vec2::new(along.floor(), row), self.seed)
            }
            Pattern::Noise => {
                0.6 * value_noise(p, self.seed) + 0.4 * value_noise(p * 2.3, self.seed ^ 0x5bd1)
            }
        };
        self.colors[0].lerp(self.colors[1], mix)
    }
}

/// Random values on the integer grid, interpolated smoothly, in [0, 1].
pub(crate) fn value_noise(p: Vec2, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let f = f * f * (3.0 - 2.0 * f);
    let at = |dx: i32, dy: i32| {
        let x = (cell.x as i32 + dx) as u64 & 0xffff_ffff;
        let y = (cell.y as i32 + dy) as u64 & 0xffff_ffff;
        let h = dipir_numerics::hashing::mix64((x << 32 | y) ^ ((seed as u64) << 17));
        (h >> 40) as f32 / (1u64 << 24) as f32
    };
    let (low, high) = (
        at(0, 0) + (at(1, 0) - at(0, 0)) * f.x,
        at(0, 1) + (at(1, 1) - at(0, 1)) * f.x,
    );
    low + (high - low) * f.y
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::GeneratedScene;

    #[test]
    fn worn_ground_has_a_possible_albedo_and_open_ground_no_wear() {
        let mut mottled = 0;
        for index in 0..20 {
            let worn = GeneratedScene::close(index, Setting::Courtyard).ground;
            let new = GeneratedScene::close(index, Setting::Open).ground;
            let mut factors = vec![];
            for i in 0..400 {
                let at = Vec2::new((i % 20) as f32, (i / 20) as f32) * 0.37 - 3.0;
                assert_eq!(new.albedo(at), new.pattern_at(at));
                let albedo = worn.albedo(at);
                assert!(
                    albedo.min_element() > 0.0 && albedo.max_element() <= 0.9,
                    "{albedo}"
                );
                factors.push(worn.wear_at(at));
            }
            mottled += usize::from(factors.iter().any(|f| *f != 1.0));
        }
        // Each kind of wear is there half of the time.
        assert!((10..20).contains(&mottled), "{mottled}");
    }
}
