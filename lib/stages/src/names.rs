//! The stages by name: one table from which graph, report, inspection and manual derive.
use std::path::PathBuf;

use dipir_cli::session::Session;
use dipir_pipeline::error::StageError;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::StagePlan;
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
    version: 10,
};
/// Samples images of the object's class.
pub const CONCEPTS: StageName = StageName {
    name: "concepts",
    executable: "dipir-concepts",
    version: 1,
};
/// Personalises the model to the photograph.
pub const LORA: StageName = StageName {
    name: "lora",
    executable: "dipir-lora",
    version: 3,
};
/// Recovers light and tone curves.
pub const LIGHT: StageName = StageName {
    name: "light",
    executable: "dipir-light",
    version: 6,
};
/// Renders the picture and its layers.
pub const COMPOSITE: StageName = StageName {
    name: "composite",
    executable: "dipir-composite",
    version: 12,
};

/// All stages, each after those that it reads.
pub const ALL: [&StageName; 5] = [&SCENE, &CONCEPTS, &LORA, &LIGHT, &COMPOSITE];

impl StageName {
    /// The stage's folder among the session's artifacts.
    pub fn folder(&self, session: &Session) -> PathBuf {
        session.stage_folder(self.name)
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
