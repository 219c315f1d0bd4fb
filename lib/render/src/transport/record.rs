//! Recording: the renderer's own loops, with rows of weights in the place of pixel sums.
use std::ops::ControlFlow;

use dipir_imaging::raster::Raster;
use dipir_light::cosine::{CosineCells, CosineWeightedMap};
use dipir_light::environment::{EnvironmentMap, EnvironmentSampler, texel_of};
use dipir_light::luminance::luminance;
use dipir_light::plane::PlaneLight;
use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::sampler::{Sampler, Stream};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::rows::{Entry, Part, RowBuilder, Rows};
use super::settings::{LEAST_UNIFORM_SHARE, RecordSettings};
use super::unit_light::{UnitLight, UnitOnPlane};
use super::{Header, Precision, RowSet, Sent, Shadow, ShadowKind, Transport, Weights};
use crate::blocker::Blocker;
use crate::counters::RayCounts;
use crate::error::RenderError;
use crate::features::with_features;
use crate::footprint::Footprint;
use crate::foreground::{Gather, PathContext};
use crate::optics::Optics;
use crate::render::{Renderer, pixels_of};
use crate::shadow::{Block, LightOnProxy, SampleRange, ShadowContext, ShadowGather};
use crate::world::{ProxyGeometry, World};

fn grey_map([width, height]: [usize; 2], values: &[f32]) -> Result<EnvironmentMap, RenderError> {
    let texels = values.iter().map(|&v| Vec3::splat(v)).collect();
    Ok(EnvironmentMap::new(width, height, texels)?)
}

/// Blocks between two reports of progress.
const BATCH: usize = 64;

/// Puts the light that paths find into rows.
struct RowGather<'a> {
    row: &'a mut RowBuilder,
    environment: [usize; 2],
    local: Vec3,
}

fn texel_index(direction: Vec3, [width, height]: [usize; 2]) -> usize {
    let (i, j) = texel_of(direction, width, height);
    i * width + j
}

impl Gather for RowGather<'_> {
    #[inline]
    fn distant(&mut self, direction: Vec3, throughput: Vec3, radiance: Vec3, weight: f32) {
        let texel = texel_index(direction, self.environment);
        self.row.add(texel, throughput * radiance * weight);
    }

    #[inline]
    fn local(&mut self, radiance: Vec3) {
        self.local += radiance;
    }
}

/// The samples of a pixel on the proxy.
#[derive(Default)]
struct ShadowRow {
    /// Direction, weight, and whether the object blocks it.
    found: Vec<(Vec3, f32, bool)>,
    /// Direction and weight of what coloured glass blocks.
    tinted: Vec<(Vec3, Vec3)>,
    /// Direction and weight of light that comes by way of the object.
    sent: Vec<(Vec3, Vec3)>,
    /// Light of the object's own.
    local: Vec3,
    hits: f32,
}

/// A path of light from the object to the proxy.
#[derive(Default)]
struct SentPath {
    distant: Vec<(Vec3, Vec3)>,
    local: Vec3,
}

impl Gather for SentPath {
    #[inline]
    fn distant(&mut self, direction: Vec3, throughput: Vec3, radiance: Vec3, weight: f32) {
        self.distant
            .push((direction, throughput * radiance * weight));
    }

    #[inline]
    fn local(&mut self, radiance: Vec3) {
        self.local += radiance;
    }
}

impl ShadowGather for ShadowRow {
    type Path = SentPath;

    #[inline]
    fn hit(&mut self) {
        self.hits += 1.0;
    }

    #[inline]
    fn arriving(&mut self, direction: Vec3, light: Vec3) {
        self.found.push((direction, light.x, false));
    }

    #[inline]
    fn blocked(&mut self, direction: Vec3, light: Vec3) {
        match light == Vec3::splat(light.x) {
            true => self.found.push((direction, light.x, true)),
            false => self.tinted.push((direction, light)),
        }
    }

    #[inline]
    fn sent(&mut self, path: SentPath, weight: f32) {
        let distant = path.distant.into_iter();
        self.sent
            .extend(distant.map(|(d, light)| (d, light * weight)));
        self.local += path.local * weight;
    }
}

/// What one task needs.
struct Recorder<'a> {
    world: &'a World<'a>,
    path: PathContext<'a, UnitLight>,
    shadow: Option<ShadowContext<'a, UnitLight, UnitOnPlane>>,
    footprint: Footprint,
    /// What is recorded as one task.
    blocks: Vec<Block>,
    settings: &'a RecordSettings<'a>,
}

/// What one task finds.
struct Recorded<C, G> {
    object: Part<C>,
    /// Pixel, base, coverage.
    seen: Vec<(u32, Vec3, f32)>,
    blocked: Part<G>,
    arriving: Part<G>,
    /// Pixel, share that shows the proxy.
    share: Vec<(u32, f32)>,
    sent: Part<C>,
    /// Pixel, irradiance that the object emits there.
    emitted: Vec<(u32, Vec3)>,
}

impl<C, G> Default for Recorded<C, G> {
    fn default() -> Self {
        Self {
            object: Part::default(),
            seen: Vec::new(),
            blocked: Part::default(),
            arriving: Part::default(),
            share: Vec::new(),
            sent: Part::default(),
            emitted: Vec::new(),
        }
    }
}

impl Transport {
    /// Traces the paths of every pixel of `renderer`'s picture and keeps what they found.
    /// `progress` gets the share that is done and may break off. The result does not depend on the
    /// number of threads.
    pub fn record(
        renderer: &Renderer,
        settings: &RecordSettings,
        progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self, RenderError> {
        let [width, height] = settings.environment;
        let limit = match settings.precision {
            Precision::Half => 1 << 16,
            Precision::Single => 1 << 26,
        };
        if width == 0 || height == 0 || width.saturating_mul(height) > limit {
            return Err(RenderError::EnvironmentSize {
                width,
                height,
                limit,
            });
        }
        renderer.check_images(settings.background, settings.occluders)?;
        let here = settings.light_here();
        let density = settings.bright_density(&here);
        let light = UnitLight {
            sampler: EnvironmentSampler::new(grey_map(settings.environment, &density)?),
        };
        let simulation = settings.simulation;
        let world = renderer.world(simulation.features)?;
        let path = PathContext::from_camera(&world, &light, &simulation, settings.background);
        let geometry = &world.geometry;
        let plane: Vec<UnitOnPlane> = match &geometry.proxy {
            ProxyGeometry::Plane(plane) => {
                let map = grey_map(settings.environment, &settings.plane_density(&here))?;
                vec![UnitOnPlane(CosineWeightedMap::new(map, plane.normal))]
            }
            _ => Vec::new(),
        };
        let blocker = geometry
            .bvh
            .bounding_sphere()
            .map(|whole| Blocker::new(whole, geometry.bvh.clusters()));
        let catches = match &geometry.proxy {
            ProxyGeometry::None => false,
            ProxyGeometry::Plane(plane) => !geometry.is_below(plane),
            ProxyGeometry::Mesh { .. } => true,
        };
        let shadow = blocker
            .as_ref()
            .filter(|_| simulation.shadow && catches)
            .map(|blocker| ShadowContext {
                path,
                blocker,
                plane: &plane,
                irradiance: std::f64::consts::PI,
                // A mask hides the shadow where they are.
                seen_surfaces: None,
                proxy_occlusion: simulation.proxy_occlusion,
                light_on_proxy: simulation.light_on_proxy,
                tolerance: 0.0,
            });
        let recorder = Recorder {
            footprint: Footprint::new(
                world.camera(),
                Optics::default(),
                geometry.bvh.bounds(),
                geometry.bvh.clusters(),
            ),
            blocks: renderer.blocks().collect(),
            world: &world,
            path,
            shadow,
            settings,
        };
        match settings.precision {
            Precision::Half => recorder.transport(density, Weights::Half, progress),
            Precision::Single => recorder.transport(density, Weights::Single, progress),
        }
    }
}

impl Recorder<'_> {
    fn transport<C: Entry, G: Entry>(
        &self,
        density: Vec<f32>,
        weights: impl Fn(RowSet<C, G>) -> Weights,
        progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Transport, RenderError> {
        let [width, height] = self.world.camera().resolution;
        let parts = self.all_blocks::<C, G>(progress)?;
        let pixels = width as usize * height as usize;
        let mut base = Raster::filled(width as usize, height as usize, Vec3::ZERO);
        let mut coverage = Raster::filled(width as usize, height as usize, 0.0);
        let mut share = vec![0f32; pixels];
        let mut emitted = vec![Vec3::ZERO; pixels];
        let (mut object, mut blocked) = (Vec::new(), Vec::new());
        let (mut arriving, mut sent) = (Vec::new(), Vec::new());
        for part in parts {
            for (p, irradiance) in part.emitted {
                emitted[p as usize] = irradiance;
            }
            sent.push(part.sent);
            for (p, local, covered) in part.seen {
                base.pixels_mut()[p as usize] = local;
                coverage.pixels_mut()[p as usize] = covered;
            }
            for (p, s) in part.share {
                share[p as usize] = s;
            }
            object.push(part.object);
            blocked.push(part.blocked);
            arriving.push(part.arriving);
        }
        let object = Rows::assemble(pixels, &object).ok_or(RenderError::TransportTooLarge)?;
        let blocked = Rows::assemble(pixels, &blocked).ok_or(RenderError::TransportTooLarge)?;
        let (kind, shadow) = match (&self.shadow, &self.world.geometry.proxy) {
            (Some(_), ProxyGeometry::Plane(plane)) => {
                let cosine = self.texel_cosines(plane.normal);
                (ShadowKind::Plane, Shadow::Plane { blocked, cosine })
            }
            (Some(_), ProxyGeometry::Mesh { .. }) => {
                let arriving =
                    Rows::assemble(pixels, &arriving).ok_or(RenderError::TransportTooLarge)?;
                let shadow = Shadow::Mesh {
                    blocked,
                    arriving,
                    share,
                };
                (ShadowKind::Mesh, shadow)
            }
            _ => (ShadowKind::None, Shadow::None),
        };
        let sent = match self.sends_light() {
            Some(_) => Some(Sent {
                rows: Rows::assemble(pixels, &sent).ok_or(RenderError::TransportTooLarge)?,
                base: emitted,
            }),
            None => None,
        };
        Ok(Transport {
            header: self.header(kind),
            base,
            coverage,
            density,
            weights: weights(RowSet {
                object,
                shadow,
                sent,
            }),
        })
    }

    /// Which light of the object counts on the proxy.
    fn sends_light(&self) -> Option<LightOnProxy> {
        self.shadow.as_ref().and_then(|s| s.light_on_proxy)
    }

    fn header(&self, shadow: ShadowKind) -> Header {
        let s = self.settings;
        Header {
            size: self.world.camera().resolution.map(|n| n as usize),
            environment: s.environment,
            samples: s.samples,
            shadow_samples: s.shadow_samples,
            precision: s.precision,
            shadow,
            uniform_share: match s.light {
                Some(_) => s.uniform_share.clamp(LEAST_UNIFORM_SHARE, 1.0),
                None => 1.0,
            },
            light_on_proxy: self.sends_light(),
            seed: s.seed,
            max_depth: s.simulation.max_depth,
            features: s.simulation.features,
            scene_hash: s.scene_hash.clone(),
        }
    }

    fn texel_cosines(&self, normal: Vec3) -> Vec<f32> {
        let [width, height] = self.settings.environment;
        let cells = CosineCells::new(width, height, normal);
        (0..height)
            .flat_map(|i| cells.row(i).map(|e| e as f32).collect::<Vec<_>>())
            .collect()
    }

    fn all_blocks<C: Entry, G: Entry>(
        &self,
        progress: &mut dyn FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Vec<Recorded<C, G>>, RenderError> {
        let (blocks, texels) = (&self.blocks, self.settings.texels());
        let mut parts = Vec::with_capacity(blocks.len());
        for batch in blocks.chunks(BATCH) {
            let mut found: Vec<Recorded<C, G>> = batch
                .par_iter()
                .map_init(
                    || RowBuilder::new(texels),
                    |row, &block| {
                        let mut out = Recorded::default();
                        self.object_block(block, row, &mut out);
                        self.shadow_block(block, row, &mut out);
                        out
                    },
                )
                .collect();
            parts.append(&mut found);
            if progress(parts.len() as f64 / blocks.len() as f64).is_break() {
                return Err(RenderError::Interrupted);
            }
        }
        Ok(parts)
    }

    /// Index of a pixel, and how much of it the photograph's own foreground leaves.
    fn pixel(&self, x: u32, y: u32) -> (u32, f32) {
        let index = y * self.world.camera().resolution[0] + x;
        let hidden = self
            .settings
            .occluders
            .map_or(0.0, |mask| mask.get(x as usize, y as usize).clamp(0.0, 1.0));
        (index, 1.0 - hidden)
    }

    fn sampler(&self, layer: u64, (x, y): (u32, u32)) -> Sampler {
        let seed = hash_u64s(&[self.settings.seed, layer]);
        Sampler::new(seed, Stream::RECORD, (y << 16) | (x & 0xffff), 0)
    }

    fn object_block<C: Entry, G>(
        &self,
        block: Block,
        row: &mut RowBuilder,
        out: &mut Recorded<C, G>,
    ) {
        with_features!(self.world.mask, F => {
            for (x, y) in pixels_of(block).filter(|&(x, y)| self.footprint.holds(x, y)) {
                let (pixel, seen) = self.pixel(x, y);
                if seen > 0.0 {
                    let (local, covered) = self.object_pixel::<F>((x, y), row);
                    let scale = seen / self.settings.samples as f32;
                    if covered > 0.0 {
                        out.seen.push((pixel, local * scale, covered * scale));
                        out.object.push(pixel, row, scale);
                    }
                }
            }
        });
    }

    /// Light that does not come from the environment, and coverage, summed over the samples.
    fn object_pixel<const F: u32>(&self, (x, y): (u32, u32), row: &mut RowBuilder) -> (Vec3, f32) {
        let corner = Vec2::new(x as f32, y as f32);
        let base = self.sampler(0, (x, y));
        let mut gather = RowGather {
            row,
            environment: self.settings.environment,
            local: Vec3::ZERO,
        };
        let mut counts = RayCounts::default();
        let mut covered = 0.0;
        for sample in 0..self.settings.samples {
            let mut sampler = base.with_sample(sample);
            covered +=
                self.path
                    .camera_trace::<F, _>(corner, &mut sampler, &mut counts, &mut gather);
        }
        (gather.local, covered)
    }

    fn shadow_block<C: Entry, G: Entry>(
        &self,
        block: Block,
        row: &mut RowBuilder,
        out: &mut Recorded<C, G>,
    ) {
        let Some(shadow) = &self.shadow else {
            return;
        };
        let range = SampleRange {
            first: 0,
            count: self.settings.shadow_samples,
        };
        let mut counts = RayCounts::default();
        let sampler = |x, y| self.sampler(1, (x, y));
        with_features!(shadow.features(), F => if shadow.plane.is_empty() {
            for (x, y) in pixels_of(block) {
                let base = sampler(x, y);
                let found = shadow.mesh_pixel::<F, ShadowRow>((x, y), range, &base, &mut counts);
                self.keep((x, y), &found, row, out);
            }
        } else {
            let mut cones: Vec<_> = shadow.plane.iter().map(PlaneLight::cone).collect();
            shadow.plane_block::<F, ShadowRow>(
                block,
                range,
                &sampler,
                &mut cones,
                &mut counts,
                &mut |x, y, found| self.keep((x, y), &found, row, out),
            );
        });
    }

    /// Makes rows of the samples of one pixel on the proxy.
    fn keep<C: Entry, G: Entry>(
        &self,
        (x, y): (u32, u32),
        found: &ShadowRow,
        row: &mut RowBuilder,
        out: &mut Recorded<C, G>,
    ) {
        let (pixel, seen) = self.pixel(x, y);
        if seen <= 0.0 {
            return;
        }
        let samples = self.settings.shadow_samples as f32;
        let texel = |direction| texel_index(direction, self.settings.environment);
        // Rows of the shadow have no colour: what coloured glass lets pass is sent, or else it blocks all channels alike.
        let is_sent = self.sends_light().is_some();
        let mut push = |part: &mut Part<G>, blocked: bool, scale: f32| {
            for &(direction, weight, _) in found.found.iter().filter(|f| f.2 == blocked) {
                row.add(texel(direction), Vec3::splat(weight));
            }
            for &(direction, light) in found.tinted.iter().filter(|_| blocked) {
                let weight = match is_sent {
                    true => light.max_element(),
                    false => luminance(light),
                };
                row.add(texel(direction), Vec3::splat(weight));
            }
            part.push(pixel, row, scale);
        };
        if let ProxyGeometry::Plane(_) = self.world.geometry.proxy {
            push(&mut out.blocked, true, seen / samples);
        } else {
            // The hidden share of the pixel is not shadowed.
            out.share.push((pixel, seen * found.hits / samples));
            push(&mut out.blocked, true, 1.0 / samples);
            push(&mut out.arriving, false, 1.0 / samples);
        }
        if is_sent {
            let scale = match self.world.geometry.proxy {
                ProxyGeometry::Plane(_) => seen / samples,
                _ => 1.0 / samples,
            };
            for &(direction, weight) in &found.sent {
                row.add(texel(direction), weight);
            }
            for &(direction, light) in &found.tinted {
                row.add(texel(direction), Vec3::splat(light.max_element()) - light);
            }
            out.sent.push(pixel, row, scale);
            out.emitted.push((pixel, found.local * scale));
        }
    }
}
