//! What ran, what it cost, what was simulated, and how to run it again.
use dipir_cli::session::{duration, size};
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::status::State;
use dipir_plotting::number;
use dipir_render::effects::EffectsPlan;

use super::html::{self, Html};
use super::{Report, Section, json};
use crate::composite::Matched;
use crate::names::{COMPOSITE, LIGHT, SCENE};

/// Every stage with its state, error, time and memory.
pub fn table(report: &Report) -> Section {
    let mut rows = Vec::new();
    for status in report.status {
        let run = report.stage(status.stage).ok().flatten();
        let manifest = run.as_ref().map(|(_, m)| m);
        let cell = |f: &dyn Fn(&Manifest) -> Option<String>| {
            Html::text(manifest.and_then(f).unwrap_or_else(|| "–".into()))
        };
        let class = match status.state {
            State::Unneeded { .. } => "off",
            _ => "",
        };
        let state = Html::element(
            "span",
            &[("class", class)],
            [Html::text(status.state.to_string())],
        );
        rows.push(vec![
            Html::of("strong", status.stage),
            state,
            cell(&|m| Some(error_in_words(status.stage, m.estimated_error?))),
            cell(&|m| Some(duration(m.elapsed_s))),
            cell(&|m| m.peak_rss_bytes.map(size)),
            cell(&|m| Some(m.device.clone())),
        ]);
    }
    let heads = [
        "stage",
        "state",
        "estimated error",
        ">time",
        ">memory",
        "device",
    ];
    Ok(Some(Html::all([
        html::table(&heads, rows),
        Html::element(
            "p",
            &[("class", "soft")],
            [Html::text(
                "Time and largest resident memory of the process that wrote the outputs; a stage \
                 that was resumed counts from there on.",
            )],
        ),
    ])))
}

/// The quantity that a stage's error belongs to.
fn error_in_words(stage: &str, error: f64) -> String {
    let unit = match stage {
        s if s == LIGHT.name => ", from the guidance's reference",
        s if s == COMPOSITE.name => ", 95% bound",
        _ => "",
    };
    format!("RMSE {}{unit}", number(error))
}

/// What is simulated, and why.
pub fn effects(report: &Report) -> Section {
    // What was done, or what could be.
    let done = match report.stage(COMPOSITE.name)? {
        Some(run) if run.1.output(&run.0, "effects").is_ok() => Some(run),
        _ => report.stage(SCENE.name)?,
    };
    let Some(run) = done else {
        return Ok(None);
    };
    let plan: EffectsPlan = json(&run, "effects")?;
    let optional = |value: Option<f64>| value.map_or_else(|| "–".into(), number);
    let rows = plan.effects.iter().map(|e| {
        let contribution = match (e.contribution, e.contribution_se) {
            (Some(c), Some(se)) => format!("{} ± {}", number(c), number(se)),
            (c, _) => optional(c),
        };
        let share = match e.time_share {
            Some(share) => format!("{:.0}%", 100.0 * share),
            None => "–".into(),
        };
        vec![
            Html::text(e.name.name().replace('_', " ")),
            Html::text(if e.enabled { "on" } else { "off" }),
            Html::text(contribution),
            Html::text(share),
            Html::text(&e.reason),
        ]
    });
    let heads = [
        "effect",
        "",
        ">contribution (RMSE)",
        ">share of the rays",
        "why",
    ];
    let rays: Vec<String> = plan.rays.iter().map(|(k, n)| format!("{k} {n}")).collect();
    let note = format!(
        "Paths of at most {} interactions. Left out: {} of display-referred RMSE, 95% bound {}. Rays: {}.",
        plan.max_depth,
        optional(plan.left_out),
        optional(plan.left_out_upper_95),
        rays.join(", ")
    );
    let look = match run.1.output(&run.0, "look").is_ok() {
        true => Some(json::<Matched>(&run, "look")?),
        false => None,
    };
    let blur = look.and_then(|look| look.text());
    let blur = blur.map(|text| format!("The object is {text} (look.json)."));
    let blurs = look.map_or_else(Vec::new, |look| look.blurs_texts());
    let blurs = blurs
        .into_iter()
        .map(|[what, text]| format!("{what}: {text} (look.json)."));
    let notes = [note].into_iter().chain(blur).chain(blurs);
    let notes = notes.map(|note| Html::element("p", &[("class", "soft")], [Html::text(note)]));
    Ok(Some(Html::all(
        [html::table(&heads, rows.collect())]
            .into_iter()
            .chain(notes),
    )))
}

/// A command for every stage.
pub fn commands(report: &Report) -> Html {
    let options = report.options.join(" ");
    let lines: Vec<String> = report
        .status
        .iter()
        .map(|s| format!("{} {options}", s.executable))
        .chain([format!("dipir run {options}")])
        .map(|line| {
            line.trim_end()
                .replace("dipir run --pipeline ", "dipir run ")
        })
        .collect();
    Html::element("pre", &[], [Html::text(lines.join("\n"))])
}

/// A word of a command as a shell takes it.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@".contains(c);
    match !word.is_empty() && word.chars().all(plain) {
        true => word.into(),
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_quoted_for_the_shell() {
        assert_eq!(quoted("scene.class=car"), "scene.class=car");
        assert_eq!(quoted("a b"), "'a b'");
        assert_eq!(quoted("it's"), r"'it'\''s'");
        assert_eq!(quoted(""), "''");
    }
}
