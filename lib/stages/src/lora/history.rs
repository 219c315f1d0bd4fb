//! The course of a training.
use std::fmt::Write as _;

use dipir_diffusion::training::StepReport;
use dipir_diffusion::validation::ValidationRow;
use serde::{Deserialize, Serialize};

/// The losses so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct History {
    /// Of each update: random crop, timestep and noise.
    pub(super) updates: Vec<StepReport>,
    /// Of the same crops, timesteps and noise.
    pub(super) validation: Vec<ValidationRow>,
}

impl History {
    /// What it was after `steps` updates.
    pub(super) fn up_to(mut self, steps: usize) -> Self {
        self.updates.truncate(steps);
        self.validation.retain(|row| row.step <= steps);
        self
    }

    /// Adds a look at the fixed examples, unless there is one after as many updates.
    pub(super) fn add(&mut self, row: ValidationRow) {
        if self
            .validation
            .last()
            .is_none_or(|last| last.step < row.step)
        {
            self.validation.push(row);
        }
    }

    /// Whether the fixed examples were looked at after so many updates.
    pub(super) fn is_validated(&self, steps: usize) -> bool {
        self.validation
            .last()
            .is_some_and(|last| last.step == steps)
    }

    /// Before the first update and after the last.
    pub(super) fn ends(&self) -> Option<(ValidationRow, ValidationRow)> {
        Some((*self.validation.first()?, *self.validation.last()?))
    }

    /// One line for each update and each validation, with a head; empty fields where there is no value.
    pub(super) fn to_csv(&self) -> String {
        let mut text = String::from(
            "step,instance_loss,prior_loss,gradient_norm,learning_rate,\
             validation_instance_loss,validation_prior_loss,change\n",
        );
        let mut validation = self.validation.iter().peekable();
        // The first validation comes before the first update.
        for step in 0..=self.updates.len() {
            let update = step.checked_sub(1).and_then(|i| self.updates.get(i));
            let looked = validation.next_if(|row| row.step == step);
            if update.is_none() && looked.is_none() {
                continue;
            }
            let _ = write!(text, "{step},");
            let _ = match update {
                Some(u) => write!(
                    text,
                    "{},{},{},{},",
                    u.instance_loss, u.prior_loss, u.gradient_norm, u.learning_rate
                ),
                None => write!(text, ",,,,"),
            };
            let _ = match looked {
                Some(v) => writeln!(text, "{},{},{}", v.instance_loss, v.prior_loss, v.change),
                None => writeln!(text, ",,"),
            };
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(step: usize, loss: f64) -> ValidationRow {
        ValidationRow {
            step,
            instance_loss: loss,
            prior_loss: 0.5,
            change: 0.0,
        }
    }

    #[test]
    fn a_table_has_a_line_for_every_update_and_for_the_start() {
        let update = StepReport {
            step: 1,
            loss: 1.5,
            instance_loss: 1.0,
            prior_loss: 0.5,
            gradient_norm: 2.0,
            learning_rate: 0.25,
        };
        let mut history = History {
            updates: vec![update, StepReport { step: 2, ..update }],
            validation: vec![],
        };
        history.add(row(0, 0.75));
        history.add(row(2, 0.25));
        history.add(row(2, 9.0));
        let csv = history.to_csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(
            lines[1..],
            [
                "0,,,,,0.75,0.5,0",
                "1,1,0.5,2,0.25,,,",
                "2,1,0.5,2,0.25,0.25,0.5,0"
            ]
        );
        let first = history.up_to(1);
        assert_eq!((first.updates.len(), first.validation.len()), (1, 1));
    }
}
