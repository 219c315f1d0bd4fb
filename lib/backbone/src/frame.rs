//! Photographs in a frame: bars of one shade that a film, a scan or a page put around them.
use dipir_imaging::raster::{LinearImage, Raster};
use glam::Vec3;

/// Most that a bar's pixels differ from its corner, roots of linear values: eight steps of a display's 255.
const ALIKE: f32 = 0.03;
/// Least of a side that is left: an upright picture of 9:16 between the bars of 16:9 has .32.
const LEAST: f32 = 0.25;
/// Beside a bar at least half of a row's pixels differ so much from it, roots of linear values: a frame ends at once, a
/// night or a wall does not.
const APART: f32 = 0.12;
/// What is cut off beside a bar, of the longer side, and in pixels: compression and scaling blur its edge.
const BLURRED: f32 = 0.004;
const BLURRED_PX: usize = 1;

/// Left, top, width and height of the picture inside a frame, pixels; `None` where there is no frame. Bars of a frame
/// are of one shade and as wide as those on the opposite side, so that the picture's middle stays where it is.
pub fn inside(photo: &LinearImage) -> Option<[usize; 4]> {
    let size = [photo.0.width(), photo.0.height()];
    if size.contains(&0) {
        return None;
    }
    let shade = |x: usize, y: usize| {
        let root = |v: f32| {
            if v.is_nan() {
                0.0
            } else {
                v.clamp(0.0, 1.0).sqrt()
            }
        };
        Vec3::from_array(photo.0.get(x, y).to_array().map(root))
    };
    let corner = shade(0, 0);
    let blurred = BLURRED_PX + (BLURRED * size[0].max(size[1]) as f32) as usize;
    // Rows first, then columns of what is left.
    let mut cut = [0; 2];
    for axis in [1, 0] {
        let across = cut[1 - axis]..size[1 - axis] - cut[1 - axis];
        // How many of a row's pixels differ from the corner by more than `least`.
        let differ = |at: usize, least: f32| {
            let pixel = |k: usize| {
                if axis == 1 {
                    shade(k, at)
                } else {
                    shade(at, k)
                }
            };
            let other = |k: &usize| (pixel(*k) - corner).abs().max_element() > least;
            across.clone().filter(other).count()
        };
        let both = |at: usize| [at, size[axis] - 1 - at];
        let most = (0.5 * (1.0 - LEAST) * size[axis] as f32) as usize;
        let alike = |at: &usize| both(*at).iter().all(|k| differ(*k, ALIKE) == 0);
        let bar = (0..most).take_while(alike).count();
        let begins = bar + blurred;
        let ends = |k: &usize| 2 * differ(*k, APART) >= across.len();
        if bar > 0 && begins <= most && both(begins).iter().all(ends) {
            cut[axis] = begins;
        }
    }
    let [left, top] = cut;
    (cut != [0; 2]).then(|| [left, top, size[0] - 2 * left, size[1] - 2 * top])
}

/// The part of a photograph that [`inside`] found.
pub fn cut(photo: &LinearImage, [left, top, width, height]: [usize; 4]) -> LinearImage {
    let rows = (top..top + height).flat_map(|y| &photo.0.row(y)[left..left + width]);
    LinearImage(Raster::from_pixels(width, height, rows.copied().collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bright picture of so many pixels between bars of so many beside and above it.
    fn framed(size: [usize; 2], bars: [usize; 2], shade: f32) -> LinearImage {
        let [w, h] = [0, 1].map(|k| size[k] + 2 * bars[k]);
        let pixel = |k: usize| {
            let (x, y) = (k % w, k / w);
            let seen = (bars[0]..bars[0] + size[0]).contains(&x)
                && (bars[1]..bars[1] + size[1]).contains(&y);
            let noise = 1e-4 * ((k * 7919) % 5) as f32;
            Vec3::splat(if seen {
                0.3 + 0.001 * y as f32
            } else {
                shade + noise
            })
        };
        LinearImage(Raster::from_pixels(w, h, (0..w * h).map(pixel).collect()))
    }

    #[test]
    fn frames_letterboxes_and_pillarboxes_are_cut_off_with_the_pixel_beside_them() {
        for shade in [0.0, 0.9] {
            for bars in [[8, 9], [0, 30], [60, 0], [1, 1]] {
                let photo = framed([60, 50], bars, shade);
                let found = inside(&photo).unwrap();
                let cut = bars.map(|b| if b > 0 { b + 1 } else { 0 });
                let wanted = [
                    cut[0],
                    cut[1],
                    photo.0.width() - 2 * cut[0],
                    photo.0.height() - 2 * cut[1],
                ];
                assert_eq!(found, wanted, "{bars:?} of {shade}");
                let least = |p: f32, v: &Vec3| p.min((v.x - shade).abs());
                let part = super::cut(&photo, found);
                assert!(part.0.pixels().iter().fold(1.0, least) > 0.2);
            }
        }
    }

    #[test]
    fn skies_nights_and_things_before_a_white_wall_are_no_frames() {
        let of = |value: &dyn Fn(usize, usize) -> f32| {
            let pixel = |k: usize| Vec3::splat(value(k % 60, k / 60));
            inside(&LinearImage(Raster::from_pixels(
                60,
                40,
                (0..2400).map(pixel).collect(),
            )))
        };
        assert_eq!(of(&|_, _| 0.0), None);
        assert_eq!(
            of(&|_, y| if y < 15 { 1.0 } else { 0.2 }),
            None,
            "a white sky"
        );
        assert_eq!(
            of(&|_, y| if y < 15 { 1.0 } else { 0.0 }),
            None,
            "above a dark ground"
        );
        let fades = |y: usize| 0.3 * (y.min(39 - y) as f32 / 20.0).powi(6);
        assert_eq!(of(&|_, y| fades(y)), None, "a night");
        let ball = |x: usize, y: usize| x.abs_diff(30).pow(2) + y.abs_diff(20).pow(2) < 150;
        assert_eq!(
            of(&|x, y| if ball(x, y) { 0.2 } else { 1.0 }),
            None,
            "a ball"
        );
        assert_eq!(
            inside(&framed([60, 2], [0, 30], 0.0)),
            None,
            "hardly anything is left"
        );
        assert_eq!(inside(&framed([1, 1], [0, 0], 0.0)), None);
    }
}
