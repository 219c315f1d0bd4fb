//! `dipir place`.
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::anyhow;
use clap::Args;
use dipir_cli::interrupt;
use dipir_placing::desk::Desk;
use dipir_placing::server::Place;
use serde_json::json;

use crate::project::FileArgs;

#[derive(Args)]
pub struct PlaceArgs {
    #[command(flatten)]
    project: FileArgs,

    /// Port of 127.0.0.1 to listen on [default: a free one]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    port: u16,

    /// Print the address and leave the browser alone
    #[arg(long)]
    no_open: bool,
}

/// Serves the page until Ctrl-C.
pub fn run(args: &PlaceArgs) -> anyhow::Result<()> {
    let session = args.project.start_waiting()?;
    let output = args.project.output;
    let set = session.config.overrides();
    if !set.is_empty() {
        output.warn(&format!(
            "the page cannot change what --set sets, and does not save it: {}",
            set.join(", ")
        ));
    }
    let place = Place::listen(Desk::open(session)?, args.port)?;
    let address = place.address();
    output.result(
        || format!("{address}\nthe page is open to this machine alone; Ctrl-C ends it"),
        || json!({"address": address}),
    );
    if !args.no_open && !open(&address) {
        output.warn("no browser could be opened: open the address by hand");
    }
    let stop = AtomicBool::new(false);
    thread::scope(|scope| {
        let server = scope.spawn(|| place.serve(&stop));
        while !interrupt::asked() && !server.is_finished() {
            thread::sleep(Duration::from_millis(100));
        }
        stop.store(true, Ordering::Relaxed);
        server
            .join()
            .unwrap_or_else(|_| Err(anyhow!("the server failed")))
    })
}

/// Opens the system's browser; false if there is none.
fn open(address: &str) -> bool {
    let (program, args): (&str, &[&str]) = match std::env::consts::OS {
        "macos" => ("open", &[]),
        "windows" => ("rundll32", &["url.dll,FileProtocolHandler"]),
        _ => ("xdg-open", &[]),
    };
    let mut command = Command::new(program);
    command.args(args).arg(address);
    command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    command.spawn().is_ok()
}
