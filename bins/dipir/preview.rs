//! `dipir preview`.
use std::path::PathBuf;

use clap::Args;
use dipir_cli::exit::printable;
use dipir_cli::session::duration;
use dipir_preview::picture::Preview;
use serde_json::json;

use crate::project::FileArgs;

#[derive(Args)]
pub struct PreviewArgs {
    #[command(flatten)]
    project: FileArgs,

    /// The picture to write; a file that dipir did not make is not replaced
    /// [default: preview.png beside the project's file]
    #[arg(long, short = 'o', value_name = "PNG")]
    out: Option<PathBuf>,

    /// Boxes and lines alone, without a draft of the objects
    #[arg(long)]
    wire: bool,
}

/// Draws what is configured, without running a stage.
pub fn run(args: &PreviewArgs) -> anyhow::Result<()> {
    let session = args.project.start()?;
    let preview = Preview::new(&session, !args.wire)?;
    for warning in &preview.arrangement.warnings {
        session.warn(warning);
    }
    let path = args.out.clone();
    let path = path.unwrap_or_else(|| session.config.base_dir().join("preview.png"));
    preview.write(&path)?;
    let light = preview.light.map(|l| l.words());
    let took = duration(preview.seconds);
    session.result(
        || {
            let light = light.map_or_else(String::new, |l| format!("; light: {l}"));
            printable(&format!("wrote {} in {took}{light}", path.display()))
        },
        || json!({"preview": path, "light": light, "seconds": preview.seconds}),
    );
    Ok(())
}
