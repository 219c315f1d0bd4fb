//! The page that asks people which of two results looks more real, and what they answered.
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;

use dipir_cli::exit::Usage;
use dipir_evaluation::results::{read_json, write};
use dipir_evaluation::study::{Answers, Verdict, pairs, verdicts};
use serde_json::json;

use crate::command_line::{StudyCountArgs, StudyPageArgs};
use crate::folder::{EvaluationFolder, TRUTH};
use crate::page::{self, Page, address};

const SCRIPT: &str = include_str!("study.js");

const QUESTION: &str = "\
<form id=\"start\"><p>You will see pairs of pictures. Each shows a photograph into which an object has been \
put by a program. Look at the light on the object and at its shadow, and choose the picture that looks \
<b>more realistic</b>: click on it, or press the left or right arrow key.</p>\
<p><label>Your name or number: <input id=\"who\" required autocomplete=\"off\"></label> \
<button class=\"act\">Start</button></p></form>\
<div id=\"task\" class=\"hidden\"><div id=\"pairs\"><p>Which is more realistic? <span id=\"count\"></span></p>\
<div class=\"pair\"><button id=\"choose-left\" aria-label=\"the left one\"><img id=\"left\" alt=\"left\"></button>\
<button id=\"choose-right\" aria-label=\"the right one\"><img id=\"right\" alt=\"right\"></button></div></div>\
<div id=\"end\" class=\"hidden\"><p><b>Thank you.</b> Save the file and send it to whoever asked you.</p></div>\
<p><button class=\"act\" id=\"back\">One back</button> <button class=\"act save\">Save choices</button></p></div>";

/// A page that was written.
pub struct StudyPage {
    /// Where it is.
    pub file: PathBuf,
    /// Pairs that it shows.
    pub pairs: usize,
    /// Scenes that it leaves out, for they have changed since a method ran on them.
    pub changed: Vec<String>,
}

/// What was answered.
pub struct StudyCount {
    /// Files of answers.
    pub participants: usize,
    /// One for each method that was compared with.
    pub verdicts: Vec<Verdict>,
}

/// Writes the page.
///
/// # Errors
/// If a method has not run, or no scene has a picture of all.
pub fn page(args: &StudyPageArgs) -> anyhow::Result<StudyPage> {
    let evaluation = EvaluationFolder::new(&args.folder.out);
    let ran = evaluation.methods()?;
    let others: Vec<String> = match args.against.is_empty() {
        true => ran
            .iter()
            .filter(|m| *m != TRUTH && **m != args.method)
            .cloned()
            .collect(),
        false => args.against.clone(),
    };
    for name in others.iter().chain([&args.method]) {
        if !ran.contains(name) {
            let text = format!(
                "method \"{name}\" has not run; accepted: {}",
                ran.join(", ")
            );
            return Err(Usage(text).into());
        }
    }
    // Only scenes that everybody has a picture of.
    let (mut scenes, mut changed) = (Vec::new(), Vec::new());
    let mut pictures: BTreeMap<String, BTreeMap<&str, String>> = BTreeMap::new();
    for scene in evaluation.scenes()? {
        let methods = || others.iter().chain([&args.method]);
        let files: Vec<(&str, PathBuf)> = methods()
            .map(|m| (m.as_str(), evaluation.picture(m, &scene.name)))
            .collect();
        let digest = evaluation.digest(&scene);
        let is_earlier = |m: &String| evaluation.is_earlier(m, &scene.name, &digest);
        if !files.iter().all(|(_, f)| f.is_file()) {
            continue;
        }
        if methods().any(is_earlier) {
            changed.push(scene.name);
        } else {
            let shown = files.into_iter().map(|(m, f)| Ok((m, address(&f)?)));
            pictures.insert(scene.name.clone(), shown.collect::<anyhow::Result<_>>()?);
            scenes.push(scene.name);
        }
    }
    if scenes.is_empty() && !changed.is_empty() {
        let text = format!(
            "every scene has changed since a method ran on it; run dipir-evaluate run again: {}",
            changed.join(", ")
        );
        return Err(Usage(text).into());
    }
    if scenes.is_empty() || others.is_empty() {
        let text = "no scene has a picture of both methods; run dipir-evaluate run first";
        return Err(Usage(text.into()).into());
    }
    let list = pairs(&scenes, &args.method, &others, args.seed);
    let count = list.len();
    let data = page::json(&json!({"seed": args.seed, "pairs": list, "pictures": pictures}))?;
    let mut page = Page::new("Which looks more real?");
    page.push(QUESTION);
    page.push(&format!(
        "<script id=\"data\" type=\"application/json\">{data}</script>"
    ));
    page.push(&format!("<script>{SCRIPT}</script>"));
    let file = evaluation.root().join("study.html");
    write(&file, page.finish())?;
    Ok(StudyPage {
        file,
        pairs: count,
        changed,
    })
}

/// Counts answers.
///
/// # Errors
/// If a file of answers cannot be read, or nobody was asked about the method.
pub fn count(args: &StudyCountArgs) -> anyhow::Result<StudyCount> {
    let answers: Vec<Answers> = args
        .answers
        .iter()
        .map(|f| read_json(f))
        .collect::<Result<_, _>>()?;
    let found = verdicts(&answers, &args.method);
    if found.is_empty() {
        let text = format!(
            "nobody was asked about \"{}\"; name another with --method",
            args.method
        );
        return Err(Usage(text).into());
    }
    Ok(StudyCount {
        participants: answers.len(),
        verdicts: found,
    })
}

/// The verdicts as lines of text.
pub fn table(found: &[Verdict]) -> String {
    let mut text = format!(
        "{} preferred to | scenes | by majority (95%) | p | of single choices | agreement\n",
        found[0].method
    );
    for v in found {
        let _ = writeln!(
            text,
            "{} | {} | {:.0}% ({:.0}% to {:.0}%) | {:.3} | {:.0}% of {} | {}",
            v.against,
            v.scenes,
            100.0 * v.preferred,
            100.0 * v.interval[0],
            100.0 * v.interval[1],
            v.p_value,
            100.0 * v.choices_preferred,
            v.choices,
            v.agreement
                .map_or("-".into(), |a| format!("{:.0}%", 100.0 * a)),
        );
    }
    text.trim_end().into()
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use dipir_evaluation::results::write_json;

    use super::*;
    use crate::columns::tests::score;
    use crate::command_line::{Cli, Command, StudyCommand};
    use crate::definition::tests::of;
    use crate::folder::SceneInfo;
    use crate::score::Score;

    #[test]
    fn pictures_of_a_scene_that_has_changed_since_are_not_shown() {
        let folder = tempfile::tempdir().unwrap();
        let evaluation = EvaluationFolder::new(folder.path());
        for name in ["a", "b"] {
            let info = json!({"name": name, "made_from": "", "map": "map.exr", "exposure_ev": 0.0, "tone": "none"});
            write_json(&evaluation.scene(name).join("scene.json"), &info).unwrap();
            let info: SceneInfo = serde_json::from_value(info).unwrap();
            for method in ["ours", "neutral"] {
                write(&evaluation.picture(method, name), "picture").unwrap();
                let scored = Score {
                    scene_digest: Some(evaluation.digest(&info)),
                    ..score(0.1, &of(method, "", &[]))
                };
                let file = evaluation.run(method, name).join("score.json");
                write_json(&file, &scored).unwrap();
            }
        }
        let out = folder.path().to_str().unwrap();
        let args = ["dipir-evaluate", "study", "page", "--out", out];
        let Command::Study(StudyCommand::Page(args)) = Cli::parse_from(args).command else {
            panic!("the command line is another's");
        };
        let shown = |page: anyhow::Result<StudyPage>| page.map(|p| (p.pairs, p.changed));
        let both = shown(page(&args)).unwrap();
        assert!(both.1.is_empty());
        write(&evaluation.scene("b").join("photo.png"), "another").unwrap();
        let one = shown(page(&args)).unwrap();
        assert_eq!(one, (both.0 / 2, vec!["b".to_string()]));
        write(&evaluation.scene("a").join("photo.png"), "another").unwrap();
        let error = shown(page(&args)).unwrap_err().to_string();
        assert!(error.starts_with("every scene has changed"), "{error}");
    }
}
