//! The stages before the composite that a method may run. The one place in this crate that lists
//! stages.
use dipir_stages::{composite, concepts, light, lora, scene};

/// What a stage is called and which version its code has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StageName {
    /// Of the stage and its folder.
    pub name: &'static str,
    /// The program that runs it.
    pub executable: &'static str,
    /// Raised whenever the same inputs give other outputs.
    pub version: u32,
}

/// All stages, each after those that it reads.
pub const ALL: [StageName; 5] = [
    StageName {
        name: scene::STAGE,
        executable: scene::EXECUTABLE,
        version: scene::VERSION,
    },
    StageName {
        name: concepts::STAGE,
        executable: concepts::EXECUTABLE,
        version: concepts::VERSION,
    },
    StageName {
        name: lora::STAGE,
        executable: lora::EXECUTABLE,
        version: lora::VERSION,
    },
    StageName {
        name: light::STAGE,
        executable: light::EXECUTABLE,
        version: light::VERSION,
    },
    StageName {
        name: composite::STAGE,
        executable: composite::EXECUTABLE,
        version: composite::VERSION,
    },
];

/// The stage called `name`.
pub fn find(name: &str) -> Option<&'static StageName> {
    ALL.iter().find(|s| s.name == name)
}
