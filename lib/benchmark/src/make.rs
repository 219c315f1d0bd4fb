//! Scenes whose true light is known.
use dipir_cli::exit::Usage;
use dipir_pretraining::scene::Setting;

use crate::command_line::{MakeArgs, Places};
use crate::folder::EvaluationFolder;
use crate::{generated, panoramas};

/// Makes scenes; those that are there already stay. `progress` gets the share that is done. Returns
/// the scenes' names.
///
/// # Errors
/// If no scene is asked for, or a panorama, a model or the table of kinds cannot be read.
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
    let mut made = Vec::new();
    if let Some(folder) = &args.hdri {
        made = panoramas::make(args, &evaluation, folder, progress)?;
    }
    let setting = match args.places {
        Places::Open => Setting::Open,
        Places::Street => Setting::Street,
        Places::Yard => Setting::Courtyard,
    };
    for n in 0..args.generated {
        progress(n as f64 / args.generated as f64);
        let side = args.size[1];
        made.push(generated::make(&evaluation, args.seed, n, side, setting)?);
    }
    Ok(made)
}
