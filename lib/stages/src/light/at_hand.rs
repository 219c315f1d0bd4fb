//! The light that is known without running a stage, for previews.
use std::sync::Arc;

use dipir_cli::session::Session;
use dipir_estimator::Visible;
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::{SgMixture, SphericalGaussian};
use dipir_optimize::lighting::Lighting;
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::settings::{LightTable, Start};
use dipir_pipeline::fingerprint::StaleReason;
use dipir_pipeline::status::State;
use dipir_render::gloss::Gloss;
use dipir_render::optics::Optics;
use dipir_scene::scene::LoadedScene;

use crate::composite::table::{CompositeTable, Tone};
use crate::light::estimate::{distribution, estimate};
use crate::light::exposed;
use crate::light::folder::{self, Recovered};
use crate::light::method::{Method, starts_neutral};
use crate::light::request::first_light;
use crate::light::surroundings::{map_of, narrow_first, surroundings};
use crate::names::{LIGHT, SCENE};
use crate::scene::{folder as scene_folder, transport};
use crate::{graph, known_light};

/// Where a light comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The map of `[composite] environment`.
    Map,
    /// What the light stage left, which is up to date but for objects that were moved since.
    Stage,
    /// The file of `[light] start`.
    File,
    /// The estimate of the photograph.
    Estimate,
    /// The same light from everywhere.
    Neutral,
}

impl Origin {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Map => "the map of [composite] environment",
            Self::Stage => "as the light stage left it",
            Self::File => "the file of [light] start",
            Self::Estimate => "estimated from the photograph",
            Self::Neutral => "neutral",
        }
    }

    /// In words, with what `[light]` of the session tells of the sun.
    ///
    /// # Errors
    /// If `[light]` cannot be read.
    pub fn words_of(self, session: &Session) -> anyhow::Result<&'static str> {
        let table: LightTable = session.config.table("light")?;
        Ok(match (self, table.sun.is_some(), table.shadow.is_some()) {
            (Self::Estimate, true, true) => {
                "estimated from the photograph, the sun as [light] sun and shadow tell"
            }
            (Self::Estimate, true, false) => {
                "estimated from the photograph, the sun as [light] sun tells"
            }
            (Self::Estimate, false, true) => {
                "estimated from the photograph, the sun as [light] shadow tells"
            }
            _ => self.words(),
        })
    }

    /// Whether what is said of the sun does not change it.
    pub fn is_fixed(self) -> bool {
        matches!(self, Self::Map | Self::File | Self::Neutral)
    }
}

/// A light, exposed and turned as `[composite]` says.
#[derive(Clone, Debug)]
pub struct AtHand {
    /// Lobes; with a map those that the map lacks.
    pub lobes: SgMixture,
    /// The rest of the light, or all of it.
    pub map: Option<Arc<EnvironmentMap>>,
    /// The curves of object and shadow, if there are any.
    pub tone: Option<ToneCurves>,
    /// The ground that it shines on, if that is polished.
    pub gloss: Option<Gloss>,
    /// What blurred the photograph, as far as it is known, whether or not it blurs the objects where they stand.
    pub optics: Optics,
    /// Where it comes from.
    pub origin: Origin,
}

/// The light of `loaded`, whose photograph and camera may be scaled: the map of `[composite]`, else
/// what the light stage left if that is up to date, else the light of `[light] start`: by default the
/// estimate of the photograph, with a reference neutral light.
///
/// # Errors
/// On tables and files that cannot be used.
pub fn at_hand(session: &Session, loaded: &LoadedScene) -> anyhow::Result<AtHand> {
    let composite: CompositeTable = session.config.table("composite")?;
    composite.check(&session.config)?;
    let optics = composite.optics(&session.config, loaded)?;
    if let Some(light) = known_light::known(session, &composite)? {
        return Ok(AtHand {
            lobes: SgMixture::new(Vec::new())?,
            map: Some(light.map),
            tone: composite.tone.and_then(Tone::curves),
            gloss: composite.gloss(),
            optics,
            origin: Origin::Map,
        });
    }
    let (light, origin) = match is_fresh(session) {
        true => {
            let scene = scene_folder::manifest(session)?;
            (
                folder::recovered(session, &composite, &scene)?,
                Origin::Stage,
            )
        }
        false => start(session, &composite, loaded)?,
    };
    Ok(AtHand {
        lobes: light.lobes,
        map: light.surroundings.map(Arc::new),
        tone: match composite.tone {
            Some(tone) => tone.curves(),
            None => exposed::tone(loaded.taken(), light.tone),
        },
        gloss: composite.gloss(),
        optics,
        origin,
    })
}

/// Whether what the scene and light stages left is up to date, but for objects that were moved since: the light is that of the
/// place.
fn is_fresh(session: &Session) -> bool {
    let moves = |r: &StaleReason| matches!(r, StaleReason::Parameter { key, .. } if key.starts_with("scene.objects"));
    let fresh = || {
        let graph = graph::graph(session).ok()?;
        let states = graph::assess(session, &graph, &graph.up_to(LIGHT.name)).ok()?;
        let of = |stage: &str| states.iter().find(|s| s.stage == stage);
        let scene = match &of(SCENE.name)?.state {
            State::Fresh => true,
            State::Stale { reasons } => reasons.iter().all(moves),
            _ => false,
        };
        let light = match &of(LIGHT.name)?.state {
            State::Fresh => true,
            // Whether it can run is not told while it waits.
            State::Waits { on, reasons } => {
                let own = || graph::state_of(session, LIGHT.name).ok() == Some(State::Fresh);
                *on == [SCENE.name] && reasons.is_empty() && own()
            }
            _ => false,
        };
        Some(scene && light)
    };
    fresh() == Some(true)
}

/// The light from which the light stage would start.
fn start(
    session: &Session,
    composite: &CompositeTable,
    loaded: &LoadedScene,
) -> anyhow::Result<(Recovered, Origin)> {
    let table: LightTable = session.config.table("light")?;
    let (lobes, map, origin) = match &table.start {
        Start::File(_) => {
            let light = first_light(session, &table)?;
            let lobes = light.as_ref().map(Lighting::exposed_lobes);
            let (lobes, map) = with_visible(&table, loaded, lobes.unwrap_or_default());
            (lobes, map, Origin::File)
        }
        start if starts_neutral(start, Method::of(session)?) => {
            let settings = transport::settings(session, &table)?;
            let ambient = ambient_of(&loaded.photo.image);
            let neutral = Parameters::neutral(settings.lobes, ambient);
            let (lobes, map) = with_visible(&table, loaded, neutral.foreground_lobes());
            (lobes, map, Origin::Neutral)
        }
        _ => {
            let (lobes, smooth, seen) = estimated(session, &table, loaded)?;
            let visible = table.visible.unwrap_or(true);
            let map = surroundings(loaded, &seen, &smooth, visible);
            (lobes, Some(map), Origin::Estimate)
        }
    };
    let tone = ToneCurves::identity();
    let light = folder::exposed(session, composite, lobes, map, tone)?;
    Ok((light, origin))
}

/// The sources of a light that is not estimated, and the rest of it with what the photograph shows, if that is asked for;
/// else all of it as lobes.
fn with_visible(
    table: &LightTable,
    loaded: &LoadedScene,
    lobes: Vec<SphericalGaussian>,
) -> (Vec<SphericalGaussian>, Option<EnvironmentMap>) {
    if table.visible != Some(true) {
        return (lobes, None);
    }
    let (mut lobes, sources) = narrow_first(&lobes);
    let map = surroundings(loaded, &[], &map_of(&lobes[sources..]), true);
    lobes.truncate(sources);
    (lobes, Some(map))
}

/// The sources of the estimated light, the rest of it, and what other photographs show of it. No lobes are fitted to
/// the rest, which takes most of the stage's time.
fn estimated(
    session: &Session,
    table: &LightTable,
    loaded: &LoadedScene,
) -> anyhow::Result<(Vec<SphericalGaussian>, EnvironmentMap, Vec<Visible>)> {
    if table.candidate.is_some() {
        let mut found = estimate(session, table, loaded, 1)?;
        found.lobes.truncate(found.sources);
        return Ok((found.lobes, found.smooth, found.seen));
    }
    let (estimate, seen, _) = distribution(session, table, loaded)?;
    Ok(match estimate.source_lobe() {
        Some(source) => (vec![source], estimate.base_map(), seen),
        None => (Vec::new(), estimate.map(), seen),
    })
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use dipir_imaging::file::write_png;
    use dipir_imaging::raster::{DisplayImage, Raster};
    use dipir_scene::scene::Scene;
    use glam::Vec3;

    use super::*;
    use crate::command_line::light::Cli;
    use crate::light::request::{First, Request};

    #[test]
    fn a_preview_starts_from_the_light_that_the_stage_starts_from() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let photo = DisplayImage(Raster::filled(36, 24, Vec3::splat(0.5)));
        write_png(at("photo.png"), &photo).unwrap();
        let object = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
        std::fs::write(at("object.obj"), object).unwrap();
        let text = "[scene]\nbackground = \"photo.png\"\n[[scene.objects]]\npath = \"object.obj\"\nposition = [0.0, 0.0, 0.0]\n\
                    [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 0.5, 0.0]\nfov_deg = 40.0\n\
                    [scene.proxy]\nplane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }\n";
        std::fs::write(at("pipeline.toml"), text).unwrap();
        let path = at("pipeline.toml").display().to_string();
        let reference = [
            "-s",
            "light.guidance=reference",
            "-s",
            "light.reference=photo.png",
        ];
        for (more, first, origin) in [
            (&[][..], First::Estimated, Origin::Estimate),
            (
                &["-s", "light.start=neutral"],
                First::Neutral,
                Origin::Neutral,
            ),
            (&reference, First::Neutral, Origin::Neutral),
            (
                &[&reference[..], &["-s", "light.start=estimated"]].concat(),
                First::Estimated,
                Origin::Estimate,
            ),
        ] {
            let args = [&["dipir-light", "-q", "-p", path.as_str()], more].concat();
            let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
            let config = session.config.table("scene").unwrap();
            let loaded = Scene::load(&config, folder.path()).unwrap();
            assert!(Request::of(&session).unwrap().start == first, "{more:?}");
            let found = at_hand(&session, &loaded).unwrap();
            assert_eq!(found.origin, origin, "{more:?}");
            assert_eq!(origin.words_of(&session).unwrap(), origin.words());
        }
        // Whatever the start, what the photograph shows belongs to the light where that is asked for.
        let visible = ["-s", "light.start=neutral", "-s", "light.visible=true"];
        let args = [&["dipir-light", "-q", "-p", path.as_str()], &visible[..]].concat();
        let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
        let loaded = Scene::load(&session.config.table("scene").unwrap(), folder.path()).unwrap();
        let found = at_hand(&session, &loaded).unwrap();
        assert_eq!(found.origin, Origin::Neutral);
        let (map, lobes) = (found.map.expect("a map"), found.lobes.lobes());
        assert!(lobes.is_empty(), "{lobes:?}");
        let ahead = -loaded.scene.camera.rotation.z_axis;
        let (i, j) = map.texel_of(ahead);
        let shown = loaded.photo.image.0.get(18, 12).x;
        assert!((map.texel(i, j).x - shown).abs() < 1e-3 * shown);
        let args = ["dipir-light", "-p", &path, "-s", "light.sun.azimuth_deg=30"];
        let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
        let words = |origin: Origin| origin.words_of(&session).unwrap();
        assert!(words(Origin::Estimate).ends_with("the sun as [light] sun tells"));
        assert_eq!(words(Origin::Stage), Origin::Stage.words());
    }
}
