//! Arguments that every stage takes.
use std::path::PathBuf;

use clap::Args;

/// Options common to all stages.
#[derive(Args, Clone, Debug)]
pub struct CommonArgs {
    /// The file that configures all stages; relative paths in it start from its folder
    #[arg(
        long,
        short = 'p',
        value_name = "FILE",
        default_value = "pipeline.toml"
    )]
    pub pipeline: PathBuf,

    /// Set a key of the file, as in --set scene.class=car or
    /// --set scene.objects.0.yaw_deg=30; may be repeated, the last one wins
    #[arg(long = "set", short = 's', value_name = "KEY=VALUE")]
    pub set: Vec<String>,

    /// Folder of all artifacts, relative to the current folder; each stage writes a folder of
    /// its own in it [default: [pipeline] out]
    #[arg(long, short = 'o', value_name = "DIR")]
    pub out: Option<PathBuf>,

    /// Worker threads, 0 for one a core; the results do not depend on it
    /// [default: [pipeline] threads]
    #[arg(long, short = 'j', value_name = "N")]
    pub threads: Option<usize>,

    /// Seed of every random number [default: [pipeline] seed]
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Wait for another run that writes the same folder instead of refusing
    #[arg(long)]
    pub wait: bool,

    /// Stop as on Ctrl-C when standard input ends, as it does when the process that started this
    /// one is gone
    #[arg(long, hide = true)]
    pub supervised: bool,

    /// File of hashes that the parent process knows; this process adds its own
    #[arg(long, value_name = "FILE", hide = true)]
    pub hashes: Option<PathBuf>,

    /// Folder of a light stage that is read in place of the one in the folder of artifacts
    #[arg(long, value_name = "DIR", hide = true)]
    pub light: Option<PathBuf>,

    /// Folder of the scene stage of a shot's photograph, where objects and ground are as in every frame
    #[arg(long, value_name = "DIR", hide = true)]
    pub placed: Option<PathBuf>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub output: OutputArgs,
}

/// Options about what is printed.
// Every command has them, and so takes a negative number for a value: the option refuses it in words of its own.
#[derive(Args, Clone, Copy, Debug, Default)]
#[command(allow_negative_numbers = true)]
pub struct OutputArgs {
    /// Print the result as JSON
    #[arg(long, global = true)]
    pub json: bool,

    /// Print errors only
    #[arg(long, short = 'q', global = true, conflicts_with = "verbose")]
    pub quiet: bool,

    /// Print more about what is done
    #[arg(long, short = 'v', global = true)]
    pub verbose: bool,
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Cli {
        #[arg(long)]
        eye_height: f64,
        #[command(flatten)]
        output: OutputArgs,
    }

    #[test]
    fn a_negative_number_is_a_value() {
        let cli = Cli::try_parse_from(["x", "--eye-height", "-1", "-q"]).unwrap();
        assert_eq!((cli.eye_height, cli.output.quiet), (-1.0, true));
        assert!(Cli::try_parse_from(["x", "--eye-height", "-x"]).is_err());
    }
}
