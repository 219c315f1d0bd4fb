//! Samples of a job: of the object, and of its shadow.
use dipir_light::plane::PlaneLight;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::{Sampler, Stream};
use glam::{Vec2, Vec3};

use crate::adaptive::Round;
use crate::contribution::{Carried, Measured};
use crate::features::{PROXY_RADIANCE, has, with_features};
use crate::foreground::PathContext;
use crate::job::{Job, Layer, REPLICATES};
use crate::light::PathLight;
use crate::shadow::{Block, SampleRange, ShadowContext, ShadowSums};

/// Columns and rows of a block's pixels, row by row.
pub(crate) fn pixels_of(block: Block) -> impl Iterator<Item = (u32, u32)> {
    (block.y..block.y + block.height)
        .flat_map(move |y| (block.x..block.x + block.width).map(move |x| (x, y)))
}

/// The sequence of one replicate of one pixel. Rows are padded to 2^16 columns, so that a crop or
/// another resolution keeps a pixel's numbers.
pub(crate) fn sequence(seed: u64, stream: Stream, replicate: usize, (x, y): (u32, u32)) -> Sampler {
    Sampler::new(
        hash_u64s(&[seed, replicate as u64]),
        stream,
        (y << 16) | (x & 0xffff),
        0,
    )
}

/// Brings `job` to `goal` samples per pixel and replicate.
pub(super) fn advance_object<L: PathLight>(
    mut path: PathContext<L>,
    seed: u64,
    job: &mut Job,
    goal: u32,
    round: &Round,
) {
    path.max_depth = round.simulation.max_depth;
    path.photo = path
        .photo
        .filter(|_| has(round.simulation.features, PROXY_RADIANCE));
    // The photograph is none of the surfaces' parts, which hold what the first round needs.
    let wanted = match path.photo {
        Some(_) => path.world.mask,
        None => path.world.mask & !PROXY_RADIANCE,
    };
    with_features!(wanted, F => advance_object_with::<_, F>(&path, seed, job, goal, round));
}

fn advance_object_with<L: PathLight, const F: u32>(
    path: &PathContext<L>,
    seed: u64,
    job: &mut Job,
    goal: u32,
    round: &Round,
) {
    let mut counts = job.counts;
    let mut measured = round.measures.map(|_| Box::<Measured>::default());
    for (index, (x, y)) in job.pixels.iter().enumerate() {
        let corner = Vec2::new(x as f32, y as f32);
        let mut found = [Carried::default(); REPLICATES];
        let (mut covered, mut drawn) = (0.0, 0.0);
        for replicate in 0..REPLICATES {
            let base = sequence(seed, Stream::FOREGROUND, replicate, (x, y));
            let (mut radiance, mut coverage, mut weights) = (Vec3::ZERO, 0.0, 0.0);
            let mut squares = Vec3::ZERO;
            for sample in job.samples..goal {
                let mut sampler = base.with_sample(sample);
                let place = sampler.next_2d();
                let (place, weight) = match &job.density {
                    Some(density) => density.place(place),
                    None => (place, 1.0),
                };
                let mut light = Carried::default();
                let point = corner + place;
                let (seen, share) =
                    path.trace_from_image::<F, _>(point, &mut sampler, &mut counts, &mut light);
                if let Some(ground) = &path.world.polished {
                    light.sum -= ground.hidden(path.world, point) * (seen * share);
                }
                radiance += light.sum * weight;
                squares += light.sum * light.sum * (weight * weight);
                coverage += seen * weight;
                weights += weight;
                if measured.is_some() {
                    found[replicate].add(&light, weight);
                }
            }
            job.add(
                index,
                replicate,
                &[radiance.x, radiance.y, radiance.z, coverage, weights],
            );
            covered += coverage;
            drawn += weights;
            if job.density.is_some() {
                job.add_squares(index, squares);
            }
        }
        if let (Some(measured), Some((_, viewing)), true) =
            (&mut measured, round.measures, covered > 0.0)
        {
            let samples = drawn / REPLICATES as f32;
            measured.object(
                (x, y),
                &found,
                covered / drawn,
                samples,
                path.max_depth,
                viewing,
            );
        }
    }
    job.measured = measured;
    job.counts = counts;
    job.samples = goal;
}

pub(super) fn advance_shadow<L: PathLight, P: PlaneLight>(
    mut shadow: ShadowContext<L, P>,
    seed: u64,
    job: &mut Job,
    goal: u32,
    round: &Round,
) {
    shadow.path.max_depth = round.simulation.max_depth;
    shadow.light_on_proxy = round.simulation.light_on_proxy;
    with_features!(shadow.features(), F => advance_shadow_with::<_, _, F>(&shadow, seed, job, goal, round));
}

fn advance_shadow_with<L: PathLight, P: PlaneLight, const F: u32>(
    shadow: &ShadowContext<L, P>,
    seed: u64,
    job: &mut Job,
    goal: u32,
    round: &Round,
) {
    let mut counts = job.counts;
    let range = SampleRange {
        first: job.samples,
        count: goal - job.samples,
    };
    let block = job.block;
    let mut found = match round.measures {
        Some(_) => vec![[ShadowSums::default(); REPLICATES]; job.pixels.len()],
        None => vec![],
    };
    for replicate in 0..REPLICATES {
        let sampler = |x, y| sequence(seed, Stream::SHADOW, replicate, (x, y));
        if job.layer == Layer::PlaneShadow {
            let mut cones: Vec<P::Cone<'_>> = shadow.plane.iter().map(PlaneLight::cone).collect();
            shadow.plane_block::<F, ShadowSums>(
                block,
                range,
                &sampler,
                &mut cones,
                &mut counts,
                &mut |x, y, sums| {
                    let index = ((y - block.y) * block.width + (x - block.x)) as usize;
                    job.add(index, replicate, &sums.blocked.to_array());
                    if let Some(found) = found.get_mut(index) {
                        found[replicate] = sums;
                    }
                },
            );
        } else {
            for (index, (x, y)) in job.pixels.iter().enumerate() {
                let s: ShadowSums =
                    shadow.mesh_pixel::<F, _>((x, y), range, &sampler(x, y), &mut counts);
                let (b, a) = (s.blocked, s.arriving);
                job.add(index, replicate, &[b.x, b.y, b.z, a.x, a.y, a.z, s.hits]);
                if let Some(found) = found.get_mut(index) {
                    found[replicate] = s;
                }
            }
        }
    }
    job.measured = round.measures.map(|seen| {
        let mut measured = Box::<Measured>::default();
        let (samples, depth) = (range.count as f32, shadow.path.max_depth);
        for (pixel, found) in job.pixels.iter().zip(&found) {
            if *found != [ShadowSums::default(); REPLICATES] {
                measured.shadow(pixel, found, job.arriving, samples, depth, seen);
            }
        }
        measured
    });
    job.counts = counts;
    job.samples = goal;
}
