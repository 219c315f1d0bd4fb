//! Which of two pictures people prefer: pairs in random order, answers, majorities, confidence.
//!
//! As in DiPIR's study: every participant sees every pair of one method's result and another's,
//! sides and order drawn at random, and picks the more realistic one; a pair counts for the
//! method that most participants picked; a share above one half says that it is preferred.
use std::collections::BTreeMap;

use dipir_numerics::hashing::hash_u64s;
use dipir_numerics::stats::normal_quantile;
use serde::{Deserialize, Serialize};

/// Two pictures to choose from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pair {
    /// Which scene.
    pub scene: String,
    /// The method shown on the left.
    pub left: String,
    /// The method shown on the right.
    pub right: String,
}

/// What one participant chose.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Answers {
    /// Who.
    pub participant: String,
    /// Seed of the order in which the pairs were shown.
    pub seed: u64,
    /// A choice a pair.
    pub choices: Vec<Choice>,
}

/// One choice.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Choice {
    /// Which scene.
    pub scene: String,
    /// The method that was preferred.
    pub preferred: String,
    /// The method that was not.
    pub over: String,
}

/// What participants think of one method beside another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// The method that is asked about.
    pub method: String,
    /// The method that it is compared with.
    pub against: String,
    /// Scenes that somebody judged.
    pub scenes: usize,
    /// Scenes that most participants gave to `method`; a tie counts for half a scene.
    pub won: f64,
    /// `won` over `scenes`.
    pub preferred: f64,
    /// 95% Wilson interval of `preferred`, scenes being independent.
    pub interval: [f64; 2],
    /// Chance of a result at least as far from one half, were both equally good: the two-sided sign
    /// test over scenes, ties left out.
    pub p_value: f64,
    /// Single choices.
    pub choices: usize,
    /// Share of single choices that went to `method`.
    pub choices_preferred: f64,
    /// How alike participants judge: mean share of pairs of participants who agree on a scene;
    /// absent where no scene was judged twice.
    pub agreement: Option<f64>,
}

/// The pairs of `method` with each of `others` on every scene, in an order and with sides that
/// follow from `seed`.
pub fn pairs(scenes: &[String], method: &str, others: &[String], seed: u64) -> Vec<Pair> {
    let mut keyed: Vec<(u64, Pair)> = Vec::new();
    for scene in scenes {
        for other in others {
            let n = keyed.len() as u64;
            let swap = hash_u64s(&[seed, n, 1]) & 1 == 1;
            let (left, right) = if swap {
                (other.as_str(), method)
            } else {
                (method, other.as_str())
            };
            let pair = Pair {
                scene: scene.clone(),
                left: left.into(),
                right: right.into(),
            };
            keyed.push((hash_u64s(&[seed, n, 0]), pair));
        }
    }
    keyed.sort_by_key(|(key, _)| *key);
    keyed.into_iter().map(|(_, pair)| pair).collect()
}

/// The verdicts on `method` against everything that it was compared with, by name. A participant
/// who judged a pair more than once counts once, by the last choice.
pub fn verdicts(answers: &[Answers], method: &str) -> Vec<Verdict> {
    // against -> scene -> participant -> whether `method` was preferred
    let mut votes: BTreeMap<&str, BTreeMap<&str, BTreeMap<&str, bool>>> = BTreeMap::new();
    for answer in answers {
        for choice in &answer.choices {
            let (against, won) = match (choice.preferred.as_str(), choice.over.as_str()) {
                (a, b) if a == method && b != method => (b, true),
                (a, b) if b == method && a != method => (a, false),
                _ => continue,
            };
            let scene = votes
                .entry(against)
                .or_default()
                .entry(&choice.scene)
                .or_default();
            scene.insert(&answer.participant, won);
        }
    }
    let verdict = |(against, scenes): (&str, BTreeMap<&str, BTreeMap<&str, bool>>)| {
        verdict(
            method,
            against,
            scenes.into_values().map(|v| v.into_values().collect()),
        )
    };
    votes.into_iter().map(verdict).collect()
}

fn verdict(method: &str, against: &str, scenes: impl Iterator<Item = Vec<bool>>) -> Verdict {
    let (mut count, mut wins, mut ties) = (0usize, 0usize, 0usize);
    let (mut choices, mut chosen) = (0, 0);
    let (mut agreeing, mut judged_twice) = (0.0, 0usize);
    for votes in scenes {
        let (n, yes) = (votes.len(), votes.iter().filter(|v| **v).count());
        count += 1;
        choices += n;
        chosen += yes;
        match (2 * yes).cmp(&n) {
            std::cmp::Ordering::Greater => wins += 1,
            std::cmp::Ordering::Equal => ties += 1,
            std::cmp::Ordering::Less => {}
        }
        if n > 1 {
            let together = |k: usize| (k * k.saturating_sub(1)) as f64;
            agreeing += (together(yes) + together(n - yes)) / together(n);
            judged_twice += 1;
        }
    }
    let won = wins as f64 + 0.5 * ties as f64;
    let preferred = won / count.max(1) as f64;
    Verdict {
        method: method.into(),
        against: against.into(),
        scenes: count,
        won,
        preferred,
        interval: wilson(preferred, count),
        p_value: sign_test(wins, count - ties),
        choices,
        choices_preferred: f64::from(chosen as u32) / choices.max(1) as f64,
        agreement: (judged_twice > 0).then(|| agreeing / judged_twice as f64),
    }
}

/// The 95% score interval of a proportion [Wilson 1927].
fn wilson(share: f64, count: usize) -> [f64; 2] {
    if count == 0 {
        return [0.0, 1.0];
    }
    let n = count as f64;
    let z = normal_quantile(0.975);
    let z2 = z * z / n;
    let center = (share + 0.5 * z2) / (1.0 + z2);
    let half = z / (1.0 + z2) * (share * (1.0 - share) / n + z2 / (4.0 * n)).sqrt();
    [(center - half).max(0.0), (center + half).min(1.0)]
}

/// Two-sided exact binomial test of one half.
fn sign_test(wins: usize, count: usize) -> f64 {
    let far = wins.max(count - wins);
    // Probabilities of `k` of `count`, as logarithms, because binomial coefficients overflow beyond
    // a thousand.
    let mut ln_choose = 0.0;
    let mut tail = 0.0;
    for k in 0..=count {
        if k > 0 {
            ln_choose += (((count - k + 1) as f64) / k as f64).ln();
        }
        if k >= far {
            tail += (ln_choose - count as f64 * std::f64::consts::LN_2).exp();
        }
    }
    (2.0 * tail).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(list: &[&str]) -> Vec<String> {
        list.iter().map(|s| s.to_string()).collect()
    }

    #[test]
    fn every_pair_is_shown_once_in_an_order_that_the_seed_decides() {
        let (scenes, others) = (names(&["a", "b", "c", "d"]), names(&["x", "y"]));
        let first = pairs(&scenes, "ours", &others, 1);
        assert_eq!(first.len(), 8);
        assert_eq!(first, pairs(&scenes, "ours", &others, 1));
        let second = pairs(&scenes, "ours", &others, 2);
        assert_ne!(first, second);
        let unordered = |list: &[Pair]| {
            let mut keys: Vec<_> = list
                .iter()
                .map(|p| {
                    let mut sides = [p.left.clone(), p.right.clone()];
                    sides.sort();
                    (p.scene.clone(), sides)
                })
                .collect();
            keys.sort();
            keys
        };
        assert_eq!(unordered(&first), unordered(&second));
        // Both sides get their turn: all on one side has a chance of 2^-31 over these seeds.
        let left = (0..4).flat_map(|s| pairs(&scenes, "ours", &others, s));
        let left = left.filter(|p| p.left == "ours").count();
        assert!(left > 0 && left < 32, "{left}");
    }

    fn answers(participant: &str, choices: &[(&str, &str, &str)]) -> Answers {
        let choice = |(scene, preferred, over): &(&str, &str, &str)| Choice {
            scene: scene.to_string(),
            preferred: preferred.to_string(),
            over: over.to_string(),
        };
        Answers {
            participant: participant.into(),
            seed: 0,
            choices: choices.iter().map(choice).collect(),
        }
    }

    #[test]
    fn majorities_are_counted_by_scene_and_ties_halve() {
        let all = [
            answers(
                "p",
                &[("a", "ours", "x"), ("b", "ours", "x"), ("c", "x", "ours")],
            ),
            answers(
                "q",
                &[("a", "ours", "x"), ("b", "x", "ours"), ("c", "x", "ours")],
            ),
            answers(
                "r",
                &[("a", "x", "ours"), ("d", "y", "ours"), ("e", "x", "y")],
            ),
        ];
        let found = verdicts(&all, "ours");
        assert_eq!(found.len(), 2);
        let x = &found[0];
        assert_eq!((x.against.as_str(), x.scenes, x.won), ("x", 3, 1.5));
        assert_eq!((x.choices, x.preferred), (7, 0.5));
        assert!((x.choices_preferred - 3.0 / 7.0).abs() < 1e-12);
        // Scene a: one pair of three agrees; b: none; c: all.
        assert!((x.agreement.unwrap() - (1.0 / 3.0 + 0.0 + 1.0) / 3.0).abs() < 1e-12);
        let y = &found[1];
        assert_eq!((y.scenes, y.won, y.agreement), (1, 0.0, None));
    }

    #[test]
    fn whoever_judges_a_pair_again_counts_once() {
        let all = [
            answers("p", &[("a", "ours", "x")]),
            answers("p", &[("a", "x", "ours")]),
        ];
        let x = &verdicts(&all, "ours")[0];
        assert_eq!((x.choices, x.won), (1, 0.0));
    }

    #[test]
    fn intervals_and_chances_equal_published_values() {
        // Wilson for 8 of 10: [0.4902, 0.9433]; the sign test: 2 * 56 / 1024.
        let [low, high] = wilson(0.8, 10);
        assert!(
            (low - 0.4902).abs() < 1e-4 && (high - 0.9433).abs() < 1e-4,
            "{low} {high}"
        );
        assert!((sign_test(8, 10) - 112.0 / 1024.0).abs() < 1e-12);
        assert!((sign_test(2, 10) - 112.0 / 1024.0).abs() < 1e-12);
        assert_eq!((sign_test(5, 10), sign_test(0, 0)), (1.0, 1.0));
        assert!(sign_test(1200, 2000) < 1e-15);
        assert_eq!(wilson(0.5, 0), [0.0, 1.0]);
    }
}
