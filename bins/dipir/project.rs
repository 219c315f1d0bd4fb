//! What all subcommands start from: a configuration, its graph, and names of stages.
use std::path::{Path, PathBuf};

use clap::{Arg, ArgAction, Args, ValueEnum};
use dipir_cli::args::{CommonArgs, OutputArgs};
use dipir_cli::exit::{Usage, printable};
use dipir_cli::interrupt;
use dipir_cli::session::Session;
use dipir_pipeline::graph::Graph;
use dipir_stages::graph;
use dipir_stages::names::{COMPOSITE, CONCEPTS, LIGHT, LORA, SCENE};
use dipir_stages::report::quoted;

use crate::suggestion;

#[derive(Args, Clone, Debug)]
pub struct ProjectArgs {
    /// The file that configures all stages; relative paths in it start from its folder
    /// [default: pipeline.toml]
    #[arg(value_name = "FILE")]
    pub files: Vec<PathBuf>,

    /// The same, as the executables of the stages name it
    #[arg(long, short = 'p', value_name = "FILE", conflicts_with = "files")]
    pub pipeline: Option<PathBuf>,

    /// Set a key of the file, as in --set scene.class=car; may be repeated, the last one wins
    #[arg(long = "set", short = 's', value_name = "KEY=VALUE")]
    pub set: Vec<String>,

    /// Folder of all artifacts, relative to the current folder [default: [pipeline] out]
    #[arg(long, short = 'o', value_name = "DIR")]
    pub out: Option<PathBuf>,

    /// Seed of every random number [default: [pipeline] seed]
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Folder of another run's light stage.
    #[arg(skip)]
    pub light: Option<PathBuf>,

    /// Folder of the scene stage of the photograph whose shot this is a frame of.
    #[arg(skip)]
    pub placed: Option<PathBuf>,

    #[command(flatten)]
    pub output: OutputArgs,
}

impl ProjectArgs {
    /// The file.
    pub fn file(&self) -> &Path {
        let named = self.pipeline.as_ref().or(self.files.first());
        named.map_or(Path::new("pipeline.toml"), |path| path)
    }

    /// The same project for each file, or for the one that is meant if none is named.
    pub fn each(&self) -> Vec<Self> {
        let one = |file: PathBuf| Self {
            files: vec![file],
            pipeline: None,
            ..self.clone()
        };
        match self.files.len() {
            0 | 1 => vec![one(self.file().to_owned())],
            _ => self.files.iter().cloned().map(one).collect(),
        }
    }

    /// The project that a stage's options name.
    pub fn of(common: &CommonArgs) -> Self {
        Self {
            files: vec![common.pipeline.clone()],
            pipeline: None,
            set: common.set.clone(),
            out: common.out.clone(),
            seed: common.seed,
            light: common.light.clone(),
            placed: common.placed.clone(),
            output: common.output,
        }
    }

    /// The same for the executables of the stages.
    pub fn common(&self) -> CommonArgs {
        CommonArgs {
            pipeline: self.file().to_owned(),
            set: self.set.clone(),
            out: self.out.clone(),
            threads: None,
            seed: self.seed,
            wait: false,
            supervised: false,
            hashes: None,
            light: self.light.clone(),
            placed: self.placed.clone(),
            output: self.output,
        }
    }

    /// The options that repeat this on the command line of a stage's executable, for a shell.
    pub fn options(&self) -> Vec<String> {
        let mut words = Vec::new();
        // One word where the value would be taken for another option.
        let mut option = |name: &str, value: String| match value.starts_with('-') {
            true => words.push(format!("{name}={value}")),
            false => words.extend([name.to_string(), value]),
        };
        if self.file() != Path::new("pipeline.toml") {
            option("--pipeline", self.file().display().to_string());
        }
        for set in &self.set {
            option("--set", set.clone());
        }
        if let Some(out) = &self.out {
            option("--out", out.display().to_string());
        }
        if let Some(seed) = self.seed {
            option("--seed", seed.to_string());
        }
        words.iter().map(|w| quoted(w)).collect()
    }

    /// Refuses a file that is not there.
    pub fn check_there(&self) -> Result<(), Usage> {
        let file = self.file();
        match file.try_exists() {
            Ok(false) => Err(Usage(printable(&format!(
                "there is no {}; name another file, as in dipir run photo/pipeline.toml, or {}",
                file.display(),
                suggestion::beginning()
            )))),
            _ => Ok(()),
        }
    }

    /// Reads the configuration and draws the graph.
    pub fn open(&self) -> anyhow::Result<(Session, Graph)> {
        self.check_there()?;
        let session = Session::open(&self.common())?;
        let graph = graph::graph(&session)?;
        Ok((session, graph))
    }
}

/// The files of [`ProjectArgs`], for commands that take one.
pub fn one_file(files: Arg) -> Arg {
    files.num_args(0..=1).action(ArgAction::Set)
}

/// One project, for commands whose results are no artifacts.
#[derive(Args, Clone, Debug)]
pub struct FileArgs {
    /// The file that configures all stages; relative paths in it start from its folder
    /// [default: pipeline.toml]
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,

    /// The same, as the executables of the stages name it
    #[arg(long, short = 'p', value_name = "FILE", conflicts_with = "file")]
    pipeline: Option<PathBuf>,

    /// Set a key of the file, as in --set scene.class=car; may be repeated, the last one wins
    #[arg(long = "set", short = 's', value_name = "KEY=VALUE")]
    pub set: Vec<String>,

    #[command(flatten)]
    pub output: OutputArgs,
}

impl FileArgs {
    /// The same as other commands take it.
    pub fn project(&self) -> ProjectArgs {
        ProjectArgs {
            files: self.file.iter().chain(&self.pipeline).cloned().collect(),
            pipeline: None,
            set: self.set.clone(),
            out: None,
            seed: None,
            light: None,
            placed: None,
            output: self.output,
        }
    }

    /// Reads the configuration, checks it, and starts the worker threads.
    pub fn start(&self) -> anyhow::Result<Session> {
        let project = self.project();
        // An error in any table is told now.
        let _ = project.open()?;
        Session::start(&project.common())
    }

    /// As [`start`](Self::start), for work that ends by itself on Ctrl-C.
    pub fn start_waiting(&self) -> anyhow::Result<Session> {
        let (session, _) = self.project().open()?;
        session.start_threads()?;
        interrupt::listen_patiently()?;
        Ok(session)
    }
}

/// A stage, on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Stage {
    /// Photo, objects, camera, and which effects to simulate
    Scene,
    /// Images of the object's class
    Concepts,
    /// The model, personalised to the photograph
    Lora,
    /// The light and the tone curves
    Light,
    /// The picture and its layers
    Composite,
}

impl Stage {
    /// Name of the stage and of its folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Scene => SCENE.name,
            Self::Concepts => CONCEPTS.name,
            Self::Lora => LORA.name,
            Self::Light => LIGHT.name,
            Self::Composite => COMPOSITE.name,
        }
    }
}
