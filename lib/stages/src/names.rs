//! The stages by name: one table from which graph, report, inspection and manual derive.
use std::fs;
use std::path::PathBuf;

use dipir_cli::exit::Usage;
use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::{StagePlan, StageWriter};
use serde_json::Value;

/// What a stage is called and which version its code has.
#[derive(Debug, PartialEq, Eq)]
pub struct StageName {
    /// Of the stage, its folder and its table.
    pub name: &'static str,
    /// The program that runs it.
    pub executable: &'static str,
    /// Raised whenever the same inputs give other outputs.
    pub version: u32,
}

/// Reads photograph, objects, camera and proxy; says what can be simulated.
pub const SCENE: StageName = StageName {
    name: "scene",
    executable: "dipir-scene",
    version: 21,
};
/// Samples images of the object's class.
pub const CONCEPTS: StageName = StageName {
    name: "concepts",
    executable: "dipir-concepts",
    version: 4,
};
/// Personalises the model to the photograph.
pub const LORA: StageName = StageName {
    name: "lora",
    executable: "dipir-lora",
    version: 6,
};
/// Recovers light and tone curves.
pub const LIGHT: StageName = StageName {
    name: "light",
    executable: "dipir-light",
    version: 12,
};
/// Renders the picture and its layers.
pub const COMPOSITE: StageName = StageName {
    name: "composite",
    executable: "dipir-composite",
    version: 21,
};

/// All stages, each after those that it reads.
pub const ALL: [&StageName; 5] = [&SCENE, &CONCEPTS, &LORA, &LIGHT, &COMPOSITE];

impl StageName {
    /// The stage's folder among the session's artifacts, or that of the run whose light is taken.
    pub fn folder(&self, session: &Session) -> PathBuf {
        match &session.light {
            Some(light) if self.name == LIGHT.name => light.clone(),
            _ => session.stage_folder(self.name),
        }
    }

    /// The manifest that the stage left; an error that names the executable if there is none.
    pub fn manifest(&self, session: &Session) -> Result<Manifest, StageError> {
        Manifest::read(&self.folder(session), self.executable)
    }

    /// A plan of the stage, without inputs.
    pub fn plan(&self, session: &Session, params: Value) -> StagePlan {
        StagePlan::new(self.name, self.version, params, session.pipeline.seed)
    }
}

/// Opens the folder of the planned stage for writing.
///
/// # Errors
/// Those of [`refuse_replaced`] and [`Session::begin`].
pub fn begin(session: &Session, plan: StagePlan) -> anyhow::Result<StageWriter> {
    refuse_replaced(session, &plan)?;
    Ok(session.begin(plan)?)
}

/// Refuses a plan that reads an output of its own stage or of a later one: the run would replace what it reads.
pub fn refuse_replaced(session: &Session, plan: &StagePlan) -> anyhow::Result<()> {
    for stage in ALL.iter().skip_while(|s| s.name != plan.stage) {
        let (Ok(folder), Ok(manifest)) = (
            fs::canonicalize(stage.folder(session)),
            stage.manifest(session),
        ) else {
            continue;
        };
        let is_output = |path: &PathBuf| {
            let found = fs::canonicalize(session.resolve(path));
            let mut outputs = manifest.outputs.iter().map(|o| folder.join(&o.path));
            found.is_ok_and(|found| outputs.any(|output| output == found))
        };
        if let Some(input) = plan.inputs.iter().find(|i| is_output(&i.path)) {
            return Err(Usage(format!(
                "the {} \"{}\" is written by the stage {}, and a run would replace it: copy it elsewhere and name the copy",
                input.role,
                input.path.display(),
                stage.name
            ))
            .into());
        }
    }
    Ok(())
}
