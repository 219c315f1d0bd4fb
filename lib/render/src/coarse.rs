//! Pictures at a lower resolution, for drafts of large frames and for time budgets in which not every pixel can be
//! sampled.
//!
//! Under a time budget, a first picture of at most [`FIRST_PIXELS`] pixels measures how long a pixel takes. The picture
//! is then rendered at 1/1, 1/2, 1/4 and so on of the frame's resolution, and enlarged: at the
//! finest whose first round is expected to take at most half of the time left. At full resolution,
//! pixels that the budget leaves without a sample all the same are taken from the first picture.
use std::ops::{AddAssign, ControlFlow, Div};
use std::time::{Duration, Instant};

use dipir_imaging::raster::{LinearImage, Raster};
use dipir_scene::camera::Camera;
use glam::Vec2;

use crate::adaptive::{Stop, Watch};
use crate::error::RenderError;
use crate::film::Film;
use crate::light::{PreparedLight, SceneLight};
use crate::render::{Rendered, Renderer, Settings, Simulation};
use crate::world::World;

/// Pixels of the first picture at most.
const FIRST_PIXELS: u64 = 1 << 16;

/// Share of the time left that the first round of the picture may be foreseen to take.
const FIRST_ROUND: f64 = 0.5;

/// A frame of fewer pixels than this is rendered without a first picture: its first round takes no
/// longer than a first picture may.
const LEAST_PIXELS: u64 = 4 * FIRST_PIXELS;

impl Renderer<'_> {
    /// Renders the layers within `budget`, counted from `start`, occluders left aside.
    pub(crate) fn render_within<L: SceneLight>(
        &self,
        light: &PreparedLight<L>,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        budget: Duration,
        start: Instant,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let camera = *self.camera();
        let [width, height] = camera.resolution.map(u64::from);
        if width * height < LEAST_PIXELS {
            return self.render_world(light, world, simulation, settings, start, None, progress);
        }
        let mut at = |divisor: u32, stop, coarse: Option<&Rendered>, progress: &mut Watch| {
            let settings = Settings { stop, ..*settings };
            let film = coarse.map(|coarse| &coarse.film);
            self.render_at(
                divisor, light, world, simulation, &settings, start, film, progress,
            )
        };

        // ---- How long a pixel takes ---------------------------------------------------------
        let divisor = divisor_for(camera.resolution, Some(FIRST_PIXELS));
        let clock = Instant::now();
        let one_round = Stop::TimeBudget(Duration::ZERO);
        let first = at(divisor, one_round, None, &mut |_| ControlFlow::Continue(()))?;
        let first_s = clock.elapsed().as_secs_f64();

        // ---- As many of them as there is time for -------------------------------------------
        let left = budget.saturating_sub(start.elapsed()).as_secs_f64();
        let chosen = resolution_for(left, first_s, divisor);
        let stop = Stop::TimeBudget(budget);
        if chosen == 1 {
            return at(1, stop, Some(&first), progress);
        }
        let rendered = match chosen < divisor {
            true => at(chosen, stop, None, progress)?,
            false => first,
        };
        Ok(rendered.enlarged(chosen, [width as usize, height as usize]))
    }

    /// Renders the layers at the finest of 1/1, 1/2, 1/4 and so on of the frame's resolution that has at most
    /// `most_pixels`, and enlarges them; occluders left aside.
    pub(crate) fn render_at_most<L: SceneLight>(
        &self,
        most_pixels: Option<u64>,
        light: &PreparedLight<L>,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        start: Instant,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let [width, height] = self.camera().resolution;
        let divisor = divisor_for([width, height], most_pixels);
        let rendered = self.render_at(
            divisor, light, world, simulation, settings, start, None, progress,
        )?;
        Ok(rendered.enlarged(divisor, [width as usize, height as usize]))
    }

    /// Renders the layers at `1 / divisor` of the frame's resolution, occluders left aside; `coarse` is the same
    /// picture at a lower one.
    fn render_at<L: SceneLight>(
        &self,
        divisor: u32,
        light: &PreparedLight<L>,
        world: &mut World,
        simulation: &Simulation,
        settings: &Settings,
        start: Instant,
        coarse: Option<&Film>,
        progress: &mut Watch,
    ) -> Result<Rendered, RenderError> {
        let camera = *self.camera();
        let resolution = camera.resolution.map(|n| n.div_ceil(divisor));
        let size = resolution.map(|n| n as usize);
        let background = match (settings.background, divisor) {
            (Some(image), 2..) => Some(LinearImage(shrink(&image.0, size))),
            _ => None,
        };
        let settings = Settings {
            background: background.as_ref().or(settings.background),
            // A mask has edges, which are applied at full resolution.
            occluders: settings.occluders.filter(|_| divisor == 1),
            shadow_mask: settings.shadow_mask.filter(|_| divisor == 1),
            ..*settings
        };
        let smaller = self.with_camera(at_resolution(camera, resolution));
        world.camera = *smaller.camera();
        smaller.render_world(light, world, simulation, &settings, start, coarse, progress)
    }
}

impl Rendered {
    /// What was rendered at `1 / divisor` of the resolution, with as many pixels as the frame has.
    fn enlarged(mut self, divisor: u32, [width, height]: [usize; 2]) -> Self {
        if divisor > 1 {
            self.film = self.film.enlarged(width, height);
            self.error.touched_pixels *= u64::from(divisor).pow(2);
            self.divisor = divisor;
        }
        self
    }
}

/// The smallest power of two by which `resolution` is divided so that at most `most_pixels` are left; 1 where there is no
/// such limit.
pub fn divisor_for(resolution: [u32; 2], most_pixels: Option<u64>) -> u32 {
    let Some(most_pixels) = most_pixels else {
        return 1;
    };
    let mut divisor = 1;
    let pixels = |divisor: u32| -> u64 {
        let sides = resolution.map(|n| u64::from(n.div_ceil(divisor)));
        sides[0] * sides[1]
    };
    while pixels(divisor) > most_pixels.max(1) {
        divisor *= 2;
    }
    divisor
}

/// The smallest power of two, `first` at most, such that the first round of a picture at one over
/// it of the resolution fits into the time, where one at `1 / first` takes `first_s` seconds.
fn resolution_for(left_s: f64, first_s: f64, first: u32) -> u32 {
    let mut divisor = first;
    while divisor > 1 {
        let pixels = f64::from(2 * first / divisor).powi(2);
        if first_s * pixels > FIRST_ROUND * left_s {
            break;
        }
        divisor /= 2;
    }
    divisor
}

/// `camera` with another number of pixels for the same picture.
pub(crate) fn at_resolution(mut camera: Camera, resolution: [u32; 2]) -> Camera {
    let [width, height] = camera.resolution.map(|n| n as f32);
    let factor = Vec2::new(resolution[0] as f32 / width, resolution[1] as f32 / height);
    camera.focal_px *= factor;
    camera.principal_px *= factor;
    camera.resolution = resolution;
    camera
}

/// Averages pixels: each lands in the target pixel that holds its centre.
pub(crate) fn shrink<T>(image: &Raster<T>, [width, height]: [usize; 2]) -> Raster<T>
where
    T: Copy + Default + AddAssign + Div<f32, Output = T>,
{
    let mut sums = vec![(T::default(), 0f32); width * height];
    for y in 0..image.height() {
        let row = (2 * y + 1) * height / (2 * image.height());
        for x in 0..image.width() {
            let column = (2 * x + 1) * width / (2 * image.width());
            let sum = &mut sums[row * width + column];
            sum.0 += *image.get(x, y);
            sum.1 += 1.0;
        }
    }
    // Never larger than the image, so every target pixel has received one.
    let pixels = sums.into_iter().map(|(sum, n)| sum / n).collect();
    Raster::from_pixels(width, height, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adaptive::Progress;
    use crate::job::{Job, Layer, PixelSet};
    use crate::shadow::Block;
    use crate::shapes::icosphere;
    use crate::testing::{camera, everything, ground, matte, scene, settings, sky};
    use dipir_scene::scene::Scene;
    use glam::Vec3;

    #[test]
    fn the_resolution_is_the_finest_whose_first_round_takes_half_of_the_time() {
        // 1/8 took 1 s: 1/4 takes 4, 1/2 takes 16, 1/1 takes 64.
        let cases = [
            (0.0, 8),
            (7.9, 8),
            (8.0, 4),
            (31.9, 4),
            (32.0, 2),
            (128.0, 1),
        ];
        for (left, divisor) in cases {
            assert_eq!(resolution_for(left, 1.0, 8), divisor, "{left} s");
        }
    }

    #[test]
    fn a_divisor_leaves_no_more_pixels_than_are_wanted() {
        assert_eq!(divisor_for([960, 640], Some(1 << 20)), 1);
        assert_eq!(divisor_for([1920, 1080], Some(1 << 20)), 2);
        assert_eq!(divisor_for([6000, 4000], Some(1 << 20)), 8);
        assert_eq!(divisor_for([3, 3], Some(0)), 4);
    }

    #[test]
    fn a_picture_of_fewer_pixels_is_enlarged_and_close_to_the_whole_one() {
        let scene = ball(256);
        let whole = rendered(&scene, None);
        assert_eq!(whole.divisor, 1);
        assert_eq!(rendered(&scene, Some(1 << 16)).divisor, 1);
        let small = rendered(&scene, Some(1 << 14));
        assert_eq!(small.divisor, 2);
        assert_eq!(small.film.alpha.width(), 256);
        // A quarter, but for blocks of 8 x 8 pixels that shadow or object touch in part.
        assert!(small.samples < whole.samples / 2);
        // They differ by noise and at the ball's edge, which is smooth over two pixels.
        let pairs = small
            .film
            .alpha
            .pixels()
            .iter()
            .zip(whole.film.alpha.pixels());
        let difference = pairs.map(|(a, b)| (a - b).abs()).sum::<f32>() / 65536.0;
        // The edge, a circle of at most 360 pixels, is smoothed by a box of two pixels and a tent of four: their
        // standard deviation is one pixel, so coverage moves by at most one.
        assert!(difference < 360.0 / 65536.0, "{difference}");
    }

    /// Rendered with 8 samples a pixel, of a frame's pixels at most `most_pixels`.
    fn rendered(scene: &Scene, most_pixels: Option<u64>) -> Rendered {
        let settings = Settings {
            most_pixels,
            ..settings(8, 1)
        };
        let mut progress = |_: &Progress| ControlFlow::Continue(());
        Renderer::new(scene)
            .render(&sky(1.0), &everything(2), &settings, &mut progress)
            .unwrap()
    }

    /// A ball on the ground in a frame of `n` x `n`.
    fn ball(n: u32) -> Scene {
        let view = camera(Vec3::new(0.0, 3.0, 7.0), Vec3::new(0.0, 0.7, 0.0), 35.0, n);
        let mesh = icosphere(Vec3::Y, 1.0, 3);
        scene(mesh, matte(Vec3::splat(0.5)), view, ground())
    }

    fn within(scene: &Scene, budget: Duration) -> Rendered {
        let settings = Settings {
            stop: Stop::TimeBudget(budget),
            max_samples: 8,
            ..settings(8, 1)
        };
        let mut progress = |_: &Progress| ControlFlow::Continue(());
        Renderer::new(scene)
            .render(&sky(1.0), &everything(2), &settings, &mut progress)
            .unwrap()
    }

    #[test]
    fn without_any_time_there_is_a_picture_of_the_frames_size() {
        let scene = ball(1024);
        let rendered = within(&scene, Duration::ZERO);
        assert_eq!(rendered.divisor, 4);
        assert_eq!(rendered.film.alpha.width(), 1024);
        assert_eq!(*rendered.film.alpha.get(512, 480), 1.0);
        assert!(rendered.film.object.get(512, 480).x > 0.1);
        assert_eq!(*rendered.film.alpha.get(10, 10), 0.0);
        // In front of the ball's foot the ground sees less of the sky.
        assert!(rendered.film.shadow.get(512, 740).x < 0.95);
        // A quarter of the samples that its size would take in one round of all pixels.
        assert!(rendered.samples < 1024 * 1024);
    }

    #[test]
    fn with_time_enough_every_pixel_is_sampled_as_without_a_first_picture() {
        let scene = ball(520);
        let timed = within(&scene, Duration::from_secs(3600));
        assert_eq!(timed.divisor, 1);
        let counted = Renderer::new(&scene)
            .render(
                &sky(1.0),
                &everything(2),
                &settings(8, 1),
                &mut |_: &Progress| ControlFlow::Continue(()),
            )
            .unwrap();
        assert_eq!(timed.film.object, counted.film.object);
        assert_eq!(timed.film.shadow, counted.film.shadow);
    }

    #[test]
    fn pixels_without_samples_come_from_the_coarse_picture_and_others_do_not() {
        let mut coarse = Film::new(4, 4);
        coarse.alpha.pixels_mut().fill(0.25);
        coarse.object.pixels_mut().fill(Vec3::splat(3.0));
        let block = |x| Block {
            x,
            y: 0,
            width: 8,
            height: 8,
        };
        let job = |x| {
            Job::new(
                Layer::Object,
                block(x),
                PixelSet::new(block(x), |_| true),
                None,
            )
        };
        let mut jobs = [job(0), job(8)];
        jobs[0].samples = 1;
        let mut film = Film::new(16, 16);
        film.fill_in(&jobs, &coarse);
        assert_eq!(*film.alpha.get(7, 0), 0.0);
        assert_eq!(*film.alpha.get(8, 0), 0.25);
        assert_eq!(*film.object.get(15, 7), Vec3::splat(3.0));
        assert_eq!(*film.alpha.get(15, 8), 0.0);
    }

    #[test]
    fn enlarging_keeps_a_ramp_and_its_ends() {
        let mut film = Film::new(4, 1);
        for x in 0..4 {
            *film.alpha.get_mut(x, 0) = x as f32;
        }
        let large = film.enlarged(16, 4);
        // Centres of large pixels lie at (x + 1/2) / 4 - 1/2, held between 0 and 3.
        for x in 0..16 {
            let expected = ((x as f32 + 0.5) / 4.0 - 0.5).clamp(0.0, 3.0);
            assert!((large.alpha.get(x, 3) - expected).abs() < 1e-6);
        }
        assert_eq!(*large.shadow.get(5, 2), Vec3::ONE);
    }

    #[test]
    fn a_frame_takes_28_bytes_a_pixel_and_more_only_where_something_is_sampled() {
        let (width, height) = (6000usize, 4000);
        let mut film = Film::new(width, height);
        let pixels = (width * height) as f64;
        // And two indices for each tile of 64.
        assert!(film.bytes() as f64 / pixels < 28.2);
        // A shadow on a tenth of it.
        let mut jobs = Vec::new();
        for y in (0..400).step_by(8) {
            for x in (0..width as u32).step_by(8) {
                let block = Block {
                    x,
                    y,
                    width: 8,
                    height: 8,
                };
                let pixels = PixelSet::new(block, |_| true);
                jobs.push(Job::new(Layer::PlaneShadow, block, pixels, Some(Vec3::ONE)));
                jobs.last_mut().unwrap().samples = 1;
            }
        }
        let before = film.bytes();
        film.develop(&jobs);
        let sampled = (jobs.len() * 64) as f64;
        let variances = (film.bytes() - before) as f64 / sampled;
        // A vector that grows may hold twice of what it needs.
        assert!((12.0..=24.0).contains(&variances), "{variances}");
        let sums = jobs.iter().map(Job::bytes).sum::<usize>() as f64 / sampled;
        assert!((24.0..28.0).contains(&sums), "{sums}");
    }
}
