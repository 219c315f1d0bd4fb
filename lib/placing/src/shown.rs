//! Arrangements and lights as the page draws and says them.
use dipir_light::gaussian::SphericalGaussian;
use dipir_preview::arrangement::{Arrangement, Placed};
use dipir_preview::lines::{Kind, Piece};
use dipir_preview::marks::{Grid, horizon, outline, stick};
use dipir_scene::camera::Camera;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_stages::light::at_hand::AtHand;
use glam::DVec3;
use serde_json::{Value, json};

use crate::vanishing::turn_of_camera;

/// Height of a camera over the ground, metres.
pub(crate) fn height_over(camera: &Camera, ground: &Plane) -> f64 {
    let from = camera.position.as_dvec3() - ground.point.as_dvec3();
    ground.normal.as_dvec3().dot(from)
}

/// What the page draws and says.
pub(crate) fn view(arrangement: &Arrangement, grid: bool) -> Value {
    let camera = &arrangement.camera;
    let ground = arrangement.ground();
    let project = |p: DVec3| camera.project(p.as_vec3()).map(|p| p.to_array());
    let object = |o: &Placed| {
        let pieces = outline(camera, o);
        let size = o.size();
        json!({
            "contact": project(o.contact),
            "yaw_deg": o.yaw_rad.to_degrees(),
            "size_m": size.to_array(),
            "distance_m": o.contact.distance(camera.position.as_dvec3()),
            "lines": pieces.iter().map(line).collect::<Vec<_>>(),
        })
    };
    let focus = arrangement.objects.first();
    let stick = focus.and_then(|o| stick(camera, o));
    let (stick, label) = stick.unzip();
    let turn = turn_of_camera(camera);
    let mut view = json!({
        "objects": arrangement.objects.iter().map(object).collect::<Vec<_>>(),
        "horizon": horizon(camera, &ground).iter().map(line).collect::<Vec<_>>(),
        "stick": stick.iter().flatten().map(line).collect::<Vec<_>>(),
        "stick_label": label.map(|l| json!({"at": l.at.to_array(), "text": l.text})),
        "camera": {
            "pitch_deg": turn.pitch_deg, "roll_deg": turn.roll_deg, "fov_deg": turn.fov_deg,
            "height_m": height_over(camera, &ground),
        },
        "warnings": arrangement.warnings,
    });
    // On what is no plane the grid follows the first object.
    if grid || !matches!(arrangement.proxy, Proxy::Plane(_)) {
        let found = Grid::new(camera, &ground, focus.map(|o| o.contact));
        view["grid"] = found.pieces.iter().map(line).collect();
        view["spacing_m"] = found.spacing_m.into();
    }
    view
}

/// Kind, ends and opacity.
fn line(piece: &Piece) -> Value {
    let kind = match piece.kind {
        Kind::Grid => 0,
        Kind::MainGrid => 1,
        Kind::Horizon => 2,
        Kind::Box => 3,
        Kind::Front => 4,
        Kind::Stick => 5,
    };
    let short = |x: f64| (x * 10.0).round() / 10.0;
    let (a, b) = (piece.from, piece.to);
    let opacity = (f64::from(piece.opacity) * 100.0).round() / 100.0;
    json!([
        kind,
        short(a.x),
        short(a.y),
        short(b.x),
        short(b.y),
        opacity
    ])
}

/// A light in numbers and in `words`, which say where it comes from.
pub(crate) fn description(light: &AtHand, words: &str, camera: &Camera) -> Value {
    let strongest = light.lobes.lobes().iter().max_by(|a, b| {
        let power = |l: &SphericalGaussian| l.integral().element_sum();
        power(a).total_cmp(&power(b))
    });
    let sun = strongest.map(|lobe| {
        let d = lobe.direction.as_dvec3();
        let forward = -camera.rotation.z_axis.as_dvec3();
        let azimuth = |v: DVec3| v.x.atan2(-v.z);
        let from_view = (azimuth(d) - azimuth(forward)).to_degrees();
        let azimuth_deg = (from_view + 180.0).rem_euclid(360.0) - 180.0;
        json!({"azimuth_deg": azimuth_deg, "elevation_deg": d.y.clamp(-1.0, 1.0).asin().to_degrees()})
    });
    let (origin, fixed) = (words, light.origin.is_fixed());
    // Whether the file or the page says where the sun is.
    let told = words != light.origin.words();
    json!({"origin": origin, "fixed": fixed, "sun": sun, "told": told})
}
