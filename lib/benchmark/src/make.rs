//! Scenes whose true light is known.
use dipir_cli::exit::Usage;
use dipir_pretraining::scene::Setting;

use crate::command_line::{MakeArgs, Places};
use crate::folder::{Drawn, EvaluationFolder};
use crate::{generated, panoramas};

/// Makes scenes; those that are there already stay. `progress` gets the share that is done. Returns
/// the scenes' names.
///
/// # Errors
/// If no scene is asked for, a panorama, a model or the table of kinds cannot be read, or there are scenes that were made
/// with another seed, size or kind.
pub fn make(args: &MakeArgs, progress: &dyn Fn(f64)) -> anyhow::Result<Vec<String>> {
    let evaluation = EvaluationFolder::new(&args.folder.out);
    if args.hdri.is_none() && args.generated == 0 {
        let text = "there is nothing to make scenes from: name a folder of panoramas with --hdri, or a \
                    number of generated places with --generated";
        return Err(Usage(text.into()).into());
    }
    if args.places != Places::Open && args.generated == 0 {
        let text = "--places is about generated places: say how many with --generated";
        return Err(Usage(text.into()).into());
    }
    let setting = match args.places {
        Places::Open => Setting::Open,
        Places::Street => Setting::Street,
        Places::Yard => Setting::Courtyard,
    };
    let side = args.size[1];
    let drawn = |set: &str, size| Drawn {
        set: set.into(),
        seed: args.seed,
        size,
    };
    let of_panoramas = drawn("panoramas", args.size);
    let of_generator = drawn(generated::kind(setting), [side, side]);
    if args.hdri.is_some() {
        evaluation.refuse_others(&of_panoramas)?;
    }
    if args.generated > 0 {
        evaluation.refuse_others(&of_generator)?;
    }
    let mut made = Vec::new();
    if let Some(folder) = &args.hdri {
        made = panoramas::make(args, &evaluation, folder, &of_panoramas, progress)?;
    }
    for n in 0..args.generated {
        progress(n as f64 / args.generated as f64);
        made.push(generated::make(&evaluation, &of_generator, n, setting)?);
    }
    Ok(made)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use clap::Parser;

    use super::*;
    use crate::command_line::{Cli, Command};

    fn made(out: &Path, typed: &[&str]) -> anyhow::Result<Vec<String>> {
        let start = ["dipir-evaluate", "make", "--out", out.to_str().unwrap()];
        match Cli::try_parse_from(start.iter().chain(typed))
            .unwrap()
            .command
        {
            Command::Make(args) => make(&args, &|_| {}),
            _ => unreachable!("scenes are made"),
        }
    }

    #[test]
    fn a_set_of_scenes_has_one_seed_and_one_size() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        let first = made(out, &["--generated", "1", "--size", "8x8"]).unwrap();
        let file = out.join("scenes").join(&first[0]).join("scene.json");
        let before = std::fs::metadata(&file).unwrap().modified().unwrap();
        assert_eq!(
            made(out, &["--generated", "1", "--size", "8x8"]).unwrap(),
            first
        );
        assert_eq!(
            std::fs::metadata(&file).unwrap().modified().unwrap(),
            before
        );
        let refused = |typed: &[&str], asked: &str| {
            let error = made(out, typed).unwrap_err();
            assert!(error.is::<Usage>(), "{error:#}");
            let told = format!(
                "{} holds {}, made with --seed 0 --size 8x8, and {asked} is asked for: a set has one seed and one \
                 size; ask for the same, name another folder with --out, or remove the scenes that are there",
                out.join("scenes").display(),
                first[0]
            );
            assert_eq!(error.to_string(), told);
        };
        let seed = ["--generated", "1", "--size", "8x8", "--seed", "1"];
        refused(&seed, "--seed 1 --size 8x8");
        refused(
            &["--generated", "2", "--size", "9x9"],
            "--seed 0 --size 9x9",
        );
        // Another kind of place is another set.
        let street = ["--generated", "1", "--places", "street", "--size", "9x9"];
        assert!(made(out, &street).unwrap()[0].starts_with("street-000-"));
    }
}
