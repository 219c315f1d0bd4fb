//! What effects contribute to a picture, measured by the paths of its first round.
//!
//! Every path says how often it met the object and where its light came from. What leaving an effect out would change
//! is therefore known without another ray: the display values with all paths, less those without the effect's. Each
//! replicate of a pixel measures that difference by itself; the mean product of the two is the squared difference, in
//! which noise does not count as contribution.
use glam::Vec3;

use crate::counters::{RayCounts, RayKind};
use crate::features::{PROXY_RADIANCE, has};
use crate::film::Film;
use crate::foreground::Gather;
use crate::job::{Job, REPLICATES};
use crate::render::Simulation;
use crate::shadow::{LightOnProxy, ShadowSums, ratio};
use crate::viewing::Viewing;

/// Most interactions that are told apart.
const DEPTHS: usize = crate::effects::MAX_DEPTH as usize;

/// Light that paths found, by the effects that carry it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Carried {
    /// All of it.
    pub sum: Vec3,
    /// By the number of interactions with the object.
    by_depth: [Vec3; DEPTHS + 1],
    /// What the photograph shows more than the light in the same directions.
    photograph: Vec3,
    interactions: usize,
}

impl Gather for Carried {
    #[inline(always)]
    fn after(&mut self, interactions: u32) {
        self.interactions = (interactions as usize).min(DEPTHS);
    }

    #[inline(always)]
    fn distant(&mut self, _: Vec3, throughput: Vec3, radiance: Vec3, weight: f32) {
        self.local(throughput * radiance * weight);
    }

    #[inline(always)]
    fn local(&mut self, radiance: Vec3) {
        self.sum += radiance;
        self.by_depth[self.interactions] += radiance;
    }

    #[inline(always)]
    fn photographed(&mut self, throughput: Vec3, seen: Vec3, light: Vec3, weight: f32) {
        self.local(throughput * seen * weight);
        self.photograph += throughput * (seen - light) * weight;
    }
}

impl Carried {
    /// Adds `weight` times `other`.
    #[inline(always)]
    pub(crate) fn add(&mut self, other: &Self, weight: f32) {
        self.sum += other.sum * weight;
        for (a, b) in self.by_depth.iter_mut().zip(&other.by_depth) {
            *a += *b * weight;
        }
        self.photograph += other.photograph * weight;
    }

    /// The light of paths of more than `depth` interactions.
    fn deeper(&self, depth: usize) -> Vec3 {
        self.by_depth[depth + 1..].iter().sum()
    }
}

/// What may be left out, and what leaving it out changes. Numbers below [`DEPTHS`] stand for all interactions after
/// as many; those after them for light on the proxy and from it.
type Part = usize;
const EMISSION_ON_PROXY: Part = DEPTHS;
const BOUNCE_TO_PROXY: Part = DEPTHS + 1;
const BOUNCE_FROM_PROXY: Part = DEPTHS + 2;
const SHADOW: Part = DEPTHS + 3;
const PARTS: usize = DEPTHS + 4;

/// Sums over pixels of what one part changes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sums {
    product: f64,
    product_squared: f64,
    each: [f64; REPLICATES],
}

/// Sums over the pixels of a job, part by part.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Measured([Sums; PARTS]);

impl Measured {
    fn add(&mut self, part: Part, [a, b]: [Vec3; REPLICATES]) {
        let mean = |product: Vec3| f64::from(product.element_sum()) / 3.0;
        let product = mean(a * b);
        let each = [mean(a * a), mean(b * b)];
        if !(each[0] + each[1]).is_finite() {
            return;
        }
        let sums = &mut self.0[part];
        sums.product += product;
        sums.product_squared += product * product;
        sums.each[0] += each[0];
        sums.each[1] += each[1];
    }

    /// Adds a pixel of the object, of which every replicate found `found` in `samples` samples.
    pub(crate) fn object(
        &mut self,
        (x, y): (u32, u32),
        found: &[Carried; REPLICATES],
        coverage: f32,
        samples: f32,
        depth: u32,
        viewing: &Viewing,
    ) {
        let pixel = (x as usize, y as usize);
        let colour = (found[0].sum + found[1].sum) / (REPLICATES as f32 * samples);
        let shown = |colour| viewing.shown(pixel, colour, coverage, Vec3::ONE);
        let all = shown(colour);
        let mut add = |part, lost: [Vec3; REPLICATES]| {
            if lost != [Vec3::ZERO; REPLICATES] {
                self.add(part, lost.map(|lost| all - shown(colour - lost / samples)));
            }
        };
        for part in 1..(depth as usize).min(DEPTHS) {
            add(part, found.map(|f| f.deeper(part)));
        }
        add(BOUNCE_FROM_PROXY, found.map(|f| f.photograph));
    }

    /// Adds a pixel of the proxy, where the object's layer is that of `film`.
    pub(crate) fn shadow(
        &mut self,
        (x, y): (u32, u32),
        found: &[ShadowSums; REPLICATES],
        arriving: Option<Vec3>,
        samples: f32,
        depth: u32,
        (film, viewing): (&Film, &Viewing),
    ) {
        let (x, y) = (x as usize, y as usize);
        let (object, alpha) = (*film.object.get(x, y), *film.alpha.get(x, y));
        if alpha >= 1.0 {
            return;
        }
        let shown = |ratio| viewing.shown((x, y), object, alpha, ratio);
        let with = found.map(|f| ratio(&f, samples, arriving));
        let mean = (with[0] + with[1]) / REPLICATES as f32;
        let all = shown(mean);
        self.add(
            SHADOW,
            with.map(|ratio| all - shown(mean + Vec3::ONE - ratio)),
        );
        let mut add = |part, sent: [Vec3; REPLICATES]| {
            if sent == [Vec3::ZERO; REPLICATES] {
                return;
            }
            let changed = std::array::from_fn(|k| {
                let mut without = found[k];
                without.blocked += sent[k];
                all - shown(mean + ratio(&without, samples, arriving) - with[k])
            });
            self.add(part, changed);
        };
        add(EMISSION_ON_PROXY, found.map(|f| f.sent.by_depth[0]));
        add(BOUNCE_TO_PROXY, found.map(|f| f.sent.deeper(0)));
        for part in 1..(depth as usize).min(DEPTHS) {
            add(part, found.map(|f| f.sent.deeper(part)));
        }
    }
}

/// Display-referred RMSE over the pixels that the object or its shadow touches that leaving something out costs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Contribution {
    /// As measured.
    pub rmse: f64,
    /// Standard error of `rmse`.
    pub std_error: f64,
    /// One-sided 95% bound of it.
    pub upper_95: f64,
}

impl Contribution {
    fn new(sums: &Sums, touched_pixels: u64) -> Self {
        let n = touched_pixels.max(1) as f64;
        let mean = sums.product / n;
        let spread = (sums.product_squared / n - mean * mean).max(0.0) / n;
        // A rare event occurs in both replicates, but seldom in the same pixel of both: then all products are 0, and
        // so is their spread. Their size if the events were scattered at random is a lower bound of the standard error.
        let scattered = sums.each[0] * sums.each[1] / n.powi(3);
        let se = spread.max(scattered).sqrt();
        let rmse = mean.max(0.0).sqrt();
        // d sqrt(m) = dm / (2 sqrt(m)), but no more than the root of the error itself.
        let std_error = match se > 0.0 {
            true => se / (2.0 * rmse).max(se.sqrt()),
            false => 0.0,
        };
        Self {
            rmse,
            std_error,
            upper_95: (mean.max(0.0) + 1.645 * se).sqrt(),
        }
    }
}

/// What a render may leave out after its first round.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeaveOut {
    /// Display-referred RMSE that may be lost in all; of a target error no more than [`SHARE_OF_TARGET`] is.
    pub tolerance: f64,
    /// Interactions with the object beyond as many as are needed.
    pub depth: bool,
    /// Light that the object emits onto the proxy.
    pub emission_on_proxy: bool,
    /// Light that the object reflects onto the proxy.
    pub bounce_to_proxy: bool,
    /// What the photograph shows of the proxy, as light on the object.
    pub bounce_from_proxy: bool,
}

/// Share of a target error that may be lost by what is left out: a sixteenth of its square, which samples make up for.
pub const SHARE_OF_TARGET: f64 = 0.25;
/// The same of interactions alone, of which few paths have many: leaving them out saves little.
const SHARE_OF_DEPTH: f64 = 0.1;

/// What effects contribute, and what was left out from the second round on.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// What was simulated from the second round on.
    pub simulation: Simulation,
    /// What was allowed.
    pub tolerance: f64,
    /// What is lost at most, if the losses of all that is left out add up.
    pub lost: Contribution,
    /// Rays of the first round.
    pub first_round: RayCounts,
    parts: [Contribution; PARTS],
}

impl LeftOut {
    /// Decides from the first round of `jobs`, which simulated `simulation`, where the error is to be `target`.
    pub(crate) fn decide(
        jobs: &[Job],
        simulation: Simulation,
        allowed: &LeaveOut,
        target: Option<f64>,
        touched_pixels: u64,
    ) -> Self {
        let most = target.map_or(f64::INFINITY, |target| SHARE_OF_TARGET * target);
        let tolerance = allowed.tolerance.min(most);
        let mut sums = [Sums::default(); PARTS];
        for measured in jobs.iter().filter_map(|job| job.measured.as_ref()) {
            for (sum, job) in sums.iter_mut().zip(&measured.0) {
                sum.product += job.product;
                sum.product_squared += job.product_squared;
                sum.each[0] += job.each[0];
                sum.each[1] += job.each[1];
            }
        }
        let parts = sums.map(|sums| Contribution::new(&sums, touched_pixels));
        let mut first_round = RayCounts::default();
        jobs.iter().for_each(|job| first_round.merge(&job.counts));
        let mut decided = Self {
            simulation,
            tolerance,
            lost: Contribution::default(),
            first_round,
            parts,
        };

        // ---- Whole effects, the least important first ------------------------------------------
        let share = |kind| first_round.get(kind) as f64 / first_round.total().max(1) as f64;
        let mut open = vec![];
        if let Some(sent) = simulation.light_on_proxy {
            let saved = share(RayKind::LightOnProxy);
            if sent.emission && allowed.emission_on_proxy {
                open.push((EMISSION_ON_PROXY, saved));
            }
            if sent.bounce && allowed.bounce_to_proxy {
                open.push((BOUNCE_TO_PROXY, saved));
            }
        }
        if has(simulation.features, PROXY_RADIANCE) && allowed.bounce_from_proxy {
            open.push((BOUNCE_FROM_PROXY, share(RayKind::ProxyRadiance)));
        }
        open.sort_by(|a, b| parts[a.0].upper_95.total_cmp(&parts[b.0].upper_95));
        for (part, saved) in open {
            let lost = decided.lost.upper_95 + parts[part].upper_95;
            // As much as the squared error grows, samples have to make up for.
            let share_of_target = |lost: f64| target.map_or(0.0, |target| (lost / target).powi(2));
            let more = share_of_target(lost) - share_of_target(decided.lost.upper_95);
            if lost <= tolerance && saved > more {
                decided.leave_out(part);
            }
        }
        // ---- The smallest depth that suffices ---------------------------------------------------
        if allowed.depth {
            let most = (simulation.max_depth as usize).min(DEPTHS);
            let left = (tolerance - decided.lost.upper_95)
                .min(target.map_or(f64::INFINITY, |target| SHARE_OF_DEPTH * target));
            if let Some(depth) = (1..most).find(|&d| parts[d].upper_95 <= left) {
                decided.leave_out(depth);
            }
        }
        decided
    }

    fn leave_out(&mut self, part: Part) {
        let simulation = &mut self.simulation;
        let keep = |sent: LightOnProxy| (sent.emission || sent.bounce).then_some(sent);
        match part {
            EMISSION_ON_PROXY => {
                let rest = |sent| {
                    keep(LightOnProxy {
                        emission: false,
                        ..sent
                    })
                };
                simulation.light_on_proxy = simulation.light_on_proxy.and_then(rest);
            }
            BOUNCE_TO_PROXY => {
                let rest = |sent| {
                    keep(LightOnProxy {
                        bounce: false,
                        ..sent
                    })
                };
                simulation.light_on_proxy = simulation.light_on_proxy.and_then(rest);
            }
            BOUNCE_FROM_PROXY => simulation.features &= !PROXY_RADIANCE,
            depth => simulation.max_depth = depth as u32,
        }
        // RMSE is a norm: the sum of the parts bounds the whole.
        let contribution = self.parts[part];
        self.lost.rmse += contribution.rmse;
        self.lost.std_error += contribution.std_error;
        self.lost.upper_95 += contribution.upper_95;
    }

    /// What interactions after the first contribute.
    pub fn interreflection(&self) -> Contribution {
        self.deeper(1)
    }

    /// What interactions after `depth` contribute.
    pub fn deeper(&self, depth: u32) -> Contribution {
        let depth = depth as usize;
        match depth < DEPTHS {
            true => self.parts[depth],
            false => Contribution::default(),
        }
    }

    /// What light contributes that the object emits onto the proxy.
    pub fn emission_on_proxy(&self) -> Contribution {
        self.parts[EMISSION_ON_PROXY]
    }

    /// What light contributes that the object reflects onto the proxy.
    pub fn bounce_to_proxy(&self) -> Contribution {
        self.parts[BOUNCE_TO_PROXY]
    }

    /// What the photograph contributes as light on the object, instead of the light in the same directions.
    pub fn bounce_from_proxy(&self) -> Contribution {
        self.parts[BOUNCE_FROM_PROXY]
    }

    /// What the shadow contributes, with the light that the object sends to the proxy.
    pub fn shadow(&self) -> Contribution {
        self.parts[SHADOW]
    }
}
