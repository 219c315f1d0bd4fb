//! `dipir keys`.
use clap::Args;
use dipir_cli::args::OutputArgs;
use dipir_cli::exit::Usage;
use dipir_cli::output::print_line;
use dipir_cli::style::{bold, color_on_stdout, faint};
use dipir_stages::keys::{self, Table};
use serde_json::json;

#[derive(Args)]
pub struct KeysArgs {
    /// Show the keys whose name or description contains this, whatever its case [default: all]
    #[arg(value_name = "WORD")]
    word: Option<String>,

    /// Print a JSON schema of the file, with which editors complete and check it
    #[arg(long, conflicts_with_all = ["word", "markdown", "json"])]
    schema: bool,

    /// Print all keys as a page of Markdown
    #[arg(long, conflicts_with_all = ["word", "json"])]
    markdown: bool,

    #[command(flatten)]
    output: OutputArgs,
}

/// Says what may stand in a pipeline.toml.
pub fn run(args: &KeysArgs) -> anyhow::Result<()> {
    if args.schema {
        print_line(&format!("{:#}", keys::schema()));
        return Ok(());
    }
    if args.markdown {
        print_line(keys::markdown().trim_end());
        return Ok(());
    }
    let word = args.word.as_deref().unwrap_or_default();
    let found = keys::about(word);
    if found.is_empty() {
        return Err(none(word));
    }
    args.output
        .result(|| in_words(&found), || json!({"tables": found}));
    Ok(())
}

fn none(word: &str) -> anyhow::Error {
    let meant = keys::like(word).map_or(String::new(), |key| format!("did you mean {key}? "));
    Usage(format!(
        "no key has \"{word}\" in its name or description; {meant}dipir keys shows all of them"
    ))
    .into()
}

fn in_words(tables: &[Table]) -> String {
    let color = color_on_stdout();
    let mut paragraphs = Vec::new();
    for table in tables {
        let header = bold(&table.header(), color);
        let mut text = format!("{header}  {}", table.sentence);
        for key in &table.keys {
            let facts = format!(
                "{}; default: {}; as in {} = {}",
                key.accepted,
                key.default,
                key.name(),
                key.example
            );
            // The marks of code are for Markdown.
            let facts = faint(&facts.replace('`', ""), color);
            text += &format!(
                "\n  {}\n      {}\n      {facts}",
                bold(&key.key, color),
                key.sentence
            );
        }
        paragraphs.push(text);
    }
    paragraphs.join("\n\n")
}
