use dipir_imaging::raster::Raster;
use glam::Vec3;

use super::*;
use crate::camera::FieldOfView;

const SIZE: [u32; 2] = [240, 160];

/// What the photograph shows: the ground, a post 3 m away and a wall 9 m away.
const POST: usize = 1;
const WALL: usize = 2;

fn camera() -> Camera {
    let (eye, to) = (Vec3::new(0.0, 1.5, 0.0), Vec3::new(0.0, 0.8, -5.0));
    Camera::look_at(eye, to, Vec3::Y, FieldOfView::Vertical(0.8), SIZE)
}

fn ground() -> Proxy {
    Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    })
}

/// A square that stands across the line of sight.
fn square(x: f32, y: f32, depth: f32, half: f32) -> TriangleMesh {
    let at = |i: f32, j: f32| Vec3::new(x + i * half, y + j * half, -depth);
    TriangleMesh {
        positions: vec![at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)],
        indices: vec![[0, 1, 2], [0, 2, 3]],
        materials: vec![0; 2],
        ..TriangleMesh::default()
    }
}

/// Depths and what is seen, of a photograph of `size` pixels.
fn photographed(size: [u32; 2]) -> (Vec<f64>, Vec<usize>) {
    let camera = camera().scaled(size);
    let ground = Ground::of(&ground(), &camera);
    let post = nearest(&square(-0.4, 1.0, 3.0, 0.25), &camera);
    let wall = nearest(&square(0.0, 2.0, 9.0, 8.0), &camera);
    let [w, h] = size.map(|n| n as usize);
    let at = |i: usize| {
        let (x, y) = (i % w, i / w);
        let of_ground = ground.metres(x, y, &camera).unwrap_or(1e3);
        let seen = [
            of_ground,
            f64::from(*post.get(x, y)),
            f64::from(*wall.get(x, y)),
        ];
        let nearest = (0..3).min_by(|a, b| seen[*a].total_cmp(&seen[*b])).unwrap();
        (seen[nearest], nearest)
    };
    (0..w * h).map(at).unzip()
}

fn photo() -> (LinearImage, Vec<usize>) {
    let (_, seen) = photographed(SIZE);
    let colours = [
        Vec3::new(0.2, 0.2, 0.2),
        Vec3::new(0.5, 0.1, 0.1),
        Vec3::new(0.15, 0.2, 0.4),
    ];
    let [w, h] = SIZE.map(|n| n as usize);
    let pixels = seen.iter().map(|i| colours[*i]).collect();
    (LinearImage(Raster::from_pixels(w, h, pixels)), seen)
}

fn depths(size: [u32; 2], value: impl Fn(f64) -> f64) -> Depths {
    let (metres, _) = photographed(size);
    let [w, h] = size.map(|n| n as usize);
    let values = metres.iter().map(|m| value(*m) as f32).collect();
    Depths {
        values: Raster::from_pixels(w, h, values),
        measure: None,
        scale: None,
        has_shift: None,
        wants_surfaces: true,
    }
}

/// Shares of pixels of the object, and of others, whose mask is more than a half off what it ought to be.
fn wrong(mask: &Raster<f32>, object: &TriangleMesh, seen: &[usize]) -> [f64; 2] {
    let camera = camera();
    let on = nearest(object, &camera);
    let ground = Ground::of(&ground(), &camera);
    let mut counts = [[0.0; 2]; 2];
    for (i, &m) in mask.pixels().iter().enumerate() {
        let (x, y) = (i % SIZE[0] as usize, i / SIZE[0] as usize);
        let is_object = on.get(x, y).is_finite();
        // The wall stands behind the object, and before the ground beyond it.
        let ground_m = ground.metres(x, y, &camera);
        let is_ground = ground_m.is_some();
        // At its foot the wall is hardly before the ground.
        if seen[i] == WALL && ground_m.is_some_and(|m| m < 9.0 / 0.87) {
            continue;
        }
        let hides = match seen[i] {
            POST => is_object || is_ground,
            WALL => !is_object && is_ground,
            _ => false,
        };
        let kind = usize::from(!is_object);
        counts[kind][0] += 1.0;
        counts[kind][1] += f64::from(u8::from((m - f32::from(u8::from(hides))).abs() > 0.5));
    }
    counts.map(|[all, wrong]| wrong / all)
}

#[test]
fn what_is_nearer_hides_the_object_and_what_is_farther_does_not() {
    let (photo, seen) = photo();
    let object = square(0.0, 0.8, 5.0, 0.8);
    for (what, found) in [
        ("metres", depths(SIZE, |z| z)),
        ("another scale", depths(SIZE, |z| 0.13 * z)),
        ("disparities", depths(SIZE, |z| 200.0 / z + 31.0)),
        (
            "of a quarter of the size",
            depths(SIZE.map(|n| n / 4), |z| 1.0 / z),
        ),
        (
            "in 256 steps",
            depths(SIZE, |z| (255.0 * 1.4 / z).round() / 255.0),
        ),
    ] {
        let found = found
            .foreground(Some(&object), &ground(), &camera(), &photo)
            .unwrap();
        let [of_object, others] = wrong(&found.mask, &object, &seen);
        // Outlines are 700 of 38,400 pixels long: .9% are within half a pixel, 3.6% within half a texel of four.
        let most = if what.contains("quarter") {
            0.036
        } else {
            0.01
        };
        assert!(
            of_object < 0.01 && others < most,
            "{what}: {of_object} {others}"
        );
        assert!(found.fit.margin < 0.05, "{what}: {}", found.fit.margin);
    }
}

#[test]
fn an_outline_before_a_wall_stays_whole() {
    let (photo, seen) = photo();
    let object = square(0.6, 0.9, 5.0, 0.6);
    let coarse = depths(SIZE.map(|n| n / 6), |z| 1.0 / z);
    let found = coarse.foreground(Some(&object), &ground(), &camera(), &photo);
    let mask = found.unwrap().mask;
    let covered = least(&nearest(&object, &camera()), 1);
    for (i, depth) in covered.pixels().iter().enumerate() {
        if depth.is_finite() && seen[i] != POST {
            assert_eq!(mask.pixels()[i], 0.0, "at {} {}", i % 240, i / 240);
        }
    }
}

#[test]
fn a_scale_that_is_said_needs_no_ground() {
    let (photo, _) = photo();
    let object = square(0.0, 0.8, 5.0, 0.8);
    let mut found = depths(SIZE, |z| z / 0.25);
    let error = found.foreground(Some(&object), &Proxy::None, &camera(), &photo);
    let error = error.unwrap_err().to_string();
    assert!(error.contains("depth_scale"), "{error}");
    found.scale = Some(0.25);
    let found = found.foreground(Some(&object), &Proxy::None, &camera(), &photo);
    let found = found.unwrap();
    assert!(found.fit.fitted.is_none());
    // The post's middle is before the object, the wall behind it.
    let at = |x: f32, y: f32, depth: f32| {
        let p = camera().project(Vec3::new(x, y, -depth)).unwrap();
        *found.mask.get(p.x as usize, p.y as usize)
    };
    assert_eq!(at(-0.4, 1.0, 3.0), 1.0);
    assert_eq!(at(0.5, 1.0, 5.0), 0.0);
}

#[test]
fn a_mesh_is_ground_as_a_plane_is() {
    let (photo, _) = photo();
    let object = square(0.0, 0.8, 5.0, 0.8);
    let flat = TriangleMesh {
        positions: [[-50.0, 20.0], [50.0, 20.0], [50.0, -400.0], [-50.0, -400.0]]
            .map(|[x, z]| Vec3::new(x, 0.0, z))
            .to_vec(),
        indices: vec![[0, 1, 2], [0, 2, 3]],
        materials: vec![0; 2],
        ..TriangleMesh::default()
    };
    let disparities = depths(SIZE, |z| 1.0 / z);
    let of = |proxy: &Proxy| {
        let found = disparities.foreground(Some(&object), proxy, &camera(), &photo);
        found.unwrap()
    };
    let (plane, mesh) = (of(&ground()), of(&Proxy::Mesh(flat)));
    let scale = |f: &Foreground| f.fit.fitted.unwrap().scale.factor;
    assert!((scale(&plane) / scale(&mesh) - 1.0).abs() < 1e-3);
    let both = plane.mask.pixels().iter().zip(mesh.mask.pixels());
    let differ = both.filter(|(a, b)| (**a - **b).abs() > 0.1).count();
    // The mesh ends at the horizon.
    assert!(differ < 3 * SIZE[0] as usize, "{differ}");
}

#[test]
fn depths_of_a_lens_that_bends_lines_are_undistorted() {
    let lens = dipir_cameras::Lens {
        distortion: dipir_cameras::Distortion::brown_conrady(
            [-0.25, 0.06, 0.0, 0.0],
            [0.0; 3],
            [0.0; 2],
        )
        .unwrap(),
        ..dipir_cameras::Lens::pinhole([320.0, 240.0], DVec2::new(240.0, 240.0))
    };
    let way = Undistortion::of(&lens).unwrap();
    let folder = tempfile::tempdir().unwrap();
    // Halves of the photograph's pixels, whose values are their columns, in thousandths.
    let map = image::ImageBuffer::from_fn(160, 120, |x, _| image::Luma([x as u16 + 1]));
    image::DynamicImage::from(map)
        .save(folder.path().join("depth.png"))
        .unwrap();
    let settings = DepthSettings {
        path: "depth.png".into(),
        measure: None,
        scale: None,
        catches: false,
    };
    let found = Depths::read(&settings, folder.path(), [320, 240], Some(&way)).unwrap();
    let [w, h] = way.size().map(|n| n as usize);
    let size = [found.values.width(), found.values.height()];
    assert_eq!(size, [w / 2, h / 2]);
    for (x, y) in [(w / 2, h / 2), (w / 4, h / 3), (w - 30, h / 2)] {
        let texel = (DVec2::new((x / 2) as f64, (y / 2) as f64) + 0.5) * 2.0;
        let pixel = way.to_photo(texel).unwrap();
        let wanted = ((pixel.x / 2.0).floor() + 1.0) * 1e-3;
        let value = f64::from(*found.values.get(x / 2, y / 2));
        assert!((value - wanted).abs() < 1e-6, "{value} {wanted}");
    }
    let other = Depths::read(&settings, folder.path(), [320, 200], None).unwrap_err();
    assert!(other.to_string().contains("160 x 120"), "{other}");
}

/// The share of the post's pixels before the object that hide it, and of the ground's pixels that hide the shadow.
fn hides(found: &Depths) -> [f64; 2] {
    let (photo, seen) = photo();
    let object = square(0.0, 0.8, 5.0, 0.8);
    let found = found.foreground(Some(&object), &ground(), &camera(), &photo);
    let mask = found.unwrap().mask;
    let on = nearest(&object, &camera());
    let share = |kind: usize, of_object: bool| {
        let pixels =
            (0..seen.len()).filter(|&i| seen[i] == kind && on.pixels()[i].is_finite() == of_object);
        let (hidden, all) = pixels.fold((0.0, 0.0), |(hidden, all), i| {
            (hidden + f64::from(mask.pixels()[i]), all + 1.0)
        });
        hidden / all
    };
    [share(POST, true), share(0, false)]
}

#[test]
fn a_blurred_edge_goes_to_the_nearer_or_the_farther_side() {
    let mut blurred = depths(SIZE.map(|n| n / 2), |z| 1.0 / z);
    let sharp = hides(&blurred);
    for _ in 0..3 {
        let before = blurred.values.clone();
        let (w, h) = (before.width(), before.height());
        for y in 1..h - 1 {
            for x in 1..w - 1 {
                let around = (y - 1..y + 2).flat_map(|v| (x - 1..x + 2).map(move |u| (u, v)));
                let sum: f32 = around.map(|(u, v)| *before.get(u, v)).sum();
                *blurred.values.get_mut(x, y) = sum / 9.0;
            }
        }
    }
    let [post, ground] = hides(&blurred);
    // The post is 31 pixels wide: 3% are a quarter of a texel, of two pixels, on either side. 1% of the ground is about a pixel
    // along both sides of the post.
    assert!(post > sharp[0] - 0.03, "{post} {sharp:?}");
    assert!(ground < sharp[1] + 0.01, "{ground} {sharp:?}");
}

#[test]
fn holes_hide_nothing_and_small_ones_are_filled() {
    let mut holes = depths(SIZE, |z| z);
    let whole = hides(&holes);
    let w = SIZE[0] as usize;
    for (i, value) in holes.values.pixels_mut().iter_mut().enumerate() {
        if i % 7 == 0 || (i / w > 60 && i % w > 200) {
            *value = if i % 2 == 0 { 0.0 } else { f32::NAN };
        }
    }
    // A camera that looks a little too far down gets depths a shift.
    let [post, of_ground] = hides(&holes);
    assert!(
        (post - whole[0]).abs() < 0.01 && (of_ground - whole[1]).abs() < 0.01,
        "{post} {of_ground} {whole:?}"
    );
    let tilted = Camera {
        rotation: camera().rotation * glam::Mat3::from_rotation_x(-0.03),
        ..camera()
    };
    let (photo, _) = photo();
    let object = square(0.6, 0.9, 5.0, 0.6);
    let found = holes.foreground(Some(&object), &ground(), &tilted, &photo);
    let found = found.unwrap();
    assert!(found.fit.fitted.unwrap().scale.shift != 0.0);
    let on = nearest(&object, &tilted);
    for (i, depth) in on.pixels().iter().enumerate() {
        if depth.is_finite() && i / w > 64 && i % w > 204 {
            assert_eq!(found.mask.pixels()[i], 0.0);
        }
    }
}

#[test]
fn a_shadow_goes_on_over_a_bump() {
    let (photo, _) = photo();
    let mut bumped = depths(SIZE, |z| z);
    let camera = camera();
    let flat = Ground::of(&ground(), &camera);
    // 6 cm high, a twenty-fifth of the camera's height, in the lower right.
    for (i, value) in bumped.values.pixels_mut().iter_mut().enumerate() {
        let (x, y) = (i % SIZE[0] as usize, i / SIZE[0] as usize);
        let from = ((x as f32 - 180.0) / 25.0).powi(2) + ((y as f32 - 130.0) / 12.0).powi(2);
        if let Some(metres) = flat.metres(x, y, &camera)
            && (f64::from(*value) - metres).abs() < 1e-3 * metres
        {
            *value *= 1.0 - 0.04 * (-0.5 * from).exp();
        }
    }
    let found = bumped.foreground(None, &ground(), &camera, &photo);
    assert_eq!(*found.unwrap().mask.get(180, 130), 0.0);
}

#[test]
fn depths_that_hardly_follow_the_ground_are_doubted() {
    let (photo, _) = photo();
    let noisy = |i: usize| 1.0 + 0.25 * (((i * 7919 + 13) % 1009) as f32 / 1009.0 - 0.5);
    let mut found = depths(SIZE, |z| z);
    let fit = |depths: &Depths| {
        depths
            .foreground(None, &ground(), &camera(), &photo)
            .unwrap()
            .fit
    };
    assert_eq!(fit(&found).doubt(), None);
    for (i, value) in found.values.pixels_mut().iter_mut().enumerate() {
        *value *= noisy(i);
    }
    let doubt = fit(&found).doubt().unwrap();
    assert!(doubt.contains("nothing catches its shadow"), "{doubt}");
}

#[test]
fn maps_of_one_texel_and_of_extreme_values_give_a_finite_mask_or_are_refused() {
    let (photo, _) = photo();
    let object = square(0.0, 0.8, 5.0, 0.8);
    for value in [0.0, f32::NAN, f32::INFINITY, -1.0, f32::MAX, 1e-40] {
        for size in [[1, 1], SIZE] {
            let mut found = depths(size, |_| f64::from(value));
            found.values.pixels_mut().fill(value);
            let error = found.foreground(Some(&object), &ground(), &camera(), &photo);
            assert!(error.is_err(), "{value}");
            for scale in [f32::MIN_POSITIVE, 1.0, f32::MAX] {
                found.scale = Some(scale);
                let found = found.foreground(Some(&object), &ground(), &camera(), &photo);
                let mask = found.unwrap().mask;
                let inside = |m: &f32| (0.0..=1.0).contains(m);
                assert!(mask.pixels().iter().all(inside), "{value} {scale}");
            }
        }
    }
    // Nothing of an empty mesh can be hidden.
    let nothing = TriangleMesh::default();
    let whole = depths(SIZE, |z| z);
    let found = whole.foreground(Some(&nothing), &ground(), &camera(), &photo);
    assert!(!found.unwrap().fit.hides_objects);
}

#[test]
fn objects_behind_a_wall_are_told() {
    let (photo, _) = photo();
    let told = |depth: f32| {
        let object = square(1.5, 1.0, depth, 0.4);
        let found = depths(SIZE, |z| z).foreground(Some(&object), &ground(), &camera(), &photo);
        found.unwrap().fit.hides_objects
    };
    assert!(!told(5.0));
    assert!(told(12.0));
}
