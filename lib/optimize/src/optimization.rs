//! The loop.
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use dipir_imaging::raster::DisplayImage;
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::LobeParameters;
use glam::Vec3;

use crate::checkpoint::State;
use crate::crop::{CropSampler, CropView, Framing};
use crate::error::OptimizeError;
use crate::guidance::{Guidance, Guided, Step};
use crate::history::{Row, stands_still};
use crate::lighting::Lighting;
use crate::objective::{Forward, Objective, TermWeights};
use crate::parameters::{ParameterBounds, Parameters};
use crate::settings::Settings;
use crate::tensors::Tensors;
use crate::transport::Recorder;

/// Steps in a row that may be skipped because something was not finite. A guidance with noise
/// may stumble; one that stumbles this often will not recover.
pub(crate) const MOST_BAD_IN_A_ROW: usize = 5;
/// Iterations between two checks of how well the record samples the light.
const RECORD_EVERY: usize = 50;
/// Transport is recorded anew when its effective sample size falls below this share of its samples. A record made for
/// the current light has 1. So a lobe that narrows gets new records. Otherwise it would soon rest on few samples, the
/// optimiser would fit their noise, and the lobe would stop narrowing.
const LEAST_EFFICIENCY: f64 = 1.0;
/// The largest number of new records, so that recording stays a small part of the run.
const MOST_RECORDS: usize = 8;

/// An optimisation.
pub struct Optimization<'a> {
    /// From parameters to picture and back.
    pub objective: Objective,
    /// The loss on the picture.
    pub guidance: &'a mut dyn Guidance,
    /// Records transport anew; without it the first record serves to the end.
    pub recorder: Option<&'a mut dyn Recorder>,
    /// All numbers that can be chosen.
    pub settings: Settings,
    /// Where it starts.
    pub start: Parameters,
    /// File that keeps the state between iterations; the run goes on from it if it exists.
    pub checkpoint: Option<&'a Path>,
}

/// What happens during a run.
#[derive(Debug)]
pub enum Event<'a> {
    /// So many iterations are run, where a time budget decides.
    Planned(usize),
    /// An iteration is done.
    Step(&'a Row),
    /// The picture at the start of an iteration.
    Preview {
        /// From 0; the number of iterations for the final picture.
        iteration: usize,
        /// Display values.
        picture: &'a DisplayImage,
    },
}

/// What was found.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The light.
    pub lighting: Lighting,
    /// The tone curves.
    pub tone: ToneCurves,
    /// The picture under them.
    pub picture: DisplayImage,
    /// The parameters, both light sets apart.
    pub parameters: Parameters,
    /// One row per iteration.
    pub history: Vec<Row>,
    /// Whether the loss stood still before the last iteration.
    pub stopped_early: bool,
}

impl Outcome {
    /// Steps that were skipped because something was not finite.
    pub fn skipped(&self) -> usize {
        self.history.iter().filter(|r| r.skipped.is_some()).count()
    }
}

impl Optimization<'_> {
    /// Runs to the end, or until `watch` breaks off: then the state is kept in the checkpoint and
    /// the error is [`OptimizeError::Interrupted`].
    ///
    /// Everything but the seconds in the history is a function of the inputs: neither the number
    /// of threads nor an interruption shows in it.
    pub fn run(
        mut self,
        watch: &mut dyn FnMut(Event) -> ControlFlow<()>,
    ) -> Result<Outcome, OptimizeError> {
        let (_, rows) = self.objective.transport().environment_size();
        let bounds = match self.settings.light {
            true => ParameterBounds::for_map(rows),
            false => ParameterBounds::for_map(rows).of_tone_alone(),
        };
        let crops = CropSampler::new(self.objective.transport().coverage());
        let mut state = self.resume()?;
        if let Some(budget) = self.settings.time_budget_s
            && self.settings.iterations > 0
        {
            let planned = match state.planned {
                Some(planned) => planned,
                None => self.plan(&mut state, &crops, budget)?,
            };
            self.settings.iterations = planned;
            if watch(Event::Planned(planned)).is_break() {
                return self.interrupt(&state);
            }
            if state.iteration == 0 && self.settings.checkpoint_every > 0 {
                self.keep(&state)?;
            }
        }
        let settings = self.settings.clone();
        // A checkpoint may be of the last iteration before the end.
        let mut stopped_early =
            stands_still(&state.history, settings.patience, settings.fused_at());
        while state.iteration < settings.iterations && !stopped_early {
            let clock = Instant::now();
            let iteration = state.iteration;
            let preview =
                settings.preview_every > 0 && iteration.is_multiple_of(settings.preview_every);
            // Who breaks off at a preview goes on from before the iteration changed anything.
            let before = preview.then(|| state.clone());

            // Schedule.
            let fusion = settings.fusion(iteration);
            let rate = settings.rate(iteration);
            let step = Step {
                iteration,
                iterations: settings.iterations,
                seed: settings.seed,
            };

            // From here on both sets are what is delivered, and only the picture pulls at it: they
            // agree, and the shadow's sparsity would dim the object.
            let one_light = settings.light && iteration >= settings.fused_at();
            if one_light {
                self.objective.set_weights(TermWeights::NONE);
            }
            if one_light && iteration == settings.fused_at() {
                self.join(&mut state);
            }

            // Transport.
            let recorded = self.record_again(&mut state)?;

            // Forwards, the loss, and backwards.
            let parameters = state.parameters.to_tensors();
            let (forward, evaluation) = self.evaluate(&state.parameters, &crops, step, fusion)?;
            let evaluation = evaluation.map(|evaluation| match one_light {
                true => Evaluation {
                    gradient: evaluation.gradient.shared(&Parameters::TWINS),
                    ..evaluation
                },
                false => evaluation,
            });

            // Previews show what the step starts from.
            if let Some(before) = before {
                let picture = &forward.picture;
                if watch(Event::Preview { iteration, picture }).is_break() {
                    return self.interrupt(&before);
                }
            }

            // Step, or count what could not be taken.
            let mut row = Row {
                iteration,
                loss: None,
                guidance: None,
                consistency: Some(forward.consistency).filter(|v| v.is_finite()),
                regularizer: Some(forward.regularizer).filter(|v| v.is_finite()),
                gradient_norm: None,
                t: None,
                fusion,
                rate,
                skipped: None,
                recorded,
                seconds: 0.0,
            };
            match evaluation {
                Ok(evaluation) => {
                    let mut moved = parameters;
                    let rates = |group| rate * settings.base_rate(group);
                    state.adam.step(&mut moved, &evaluation.gradient, rates)?;
                    state.parameters = Parameters::from_tensors(&moved);
                    state.parameters.retract(&bounds);
                    state.bad_in_a_row = 0;
                    row.loss = Some(evaluation.loss + forward.consistency + forward.regularizer);
                    row.guidance = Some(evaluation.loss);
                    row.gradient_norm = Some(evaluation.gradient.norm());
                    row.t = evaluation.timestep;
                }
                Err(tensor) => {
                    state.bad_in_a_row += 1;
                    if state.bad_in_a_row >= MOST_BAD_IN_A_ROW {
                        return Err(OptimizeError::NotFinite {
                            tensor,
                            iteration,
                            in_a_row: state.bad_in_a_row,
                        });
                    }
                    row.skipped = Some(tensor);
                }
            }

            // History, checkpoint, early stop.
            row.seconds = clock.elapsed().as_secs_f64();
            let go_on = watch(Event::Step(&row));
            state.history.push(row);
            state.iteration += 1;
            if go_on.is_break() {
                return self.interrupt(&state);
            }
            let every = settings.checkpoint_every;
            if every > 0 && state.iteration.is_multiple_of(every) {
                self.keep(&state)?;
            }
            stopped_early = stands_still(&state.history, settings.patience, settings.fused_at());
        }
        self.outcome(state, stopped_early, watch)
    }

    /// The number of iterations that fit into `budget` seconds, from 1 to that of the settings: as
    /// many as the first one, evaluated twice, says. The schedule has not begun to depend on the
    /// number there, so the run is that of `iterations` set to it, byte for byte.
    fn plan(
        &mut self,
        state: &mut State,
        crops: &CropSampler,
        budget: f64,
    ) -> Result<usize, OptimizeError> {
        let first = Step {
            iteration: 0,
            iterations: self.settings.iterations,
            seed: self.settings.seed,
        };
        let clock = Instant::now();
        // The first evaluation pays for pages and caches that later ones find.
        let _ = self.evaluate(&state.parameters, crops, first, 0.0)?;
        let warm_up = clock.elapsed().as_secs_f64();
        let mut one = warm_up;
        if 2.0 * warm_up < budget {
            let _ = self.evaluate(&state.parameters, crops, first, 0.0)?;
            one = clock.elapsed().as_secs_f64() - warm_up;
        }
        let left = budget - clock.elapsed().as_secs_f64();
        let planned = ((left / one.max(1e-9)) as usize).clamp(1, self.settings.iterations);
        state.planned = Some(planned);
        Ok(planned)
    }

    /// The picture, and what the guidance says of it as a gradient of the parameters, or what was
    /// not finite.
    fn evaluate(
        &mut self,
        parameters: &Parameters,
        crops: &CropSampler,
        step: Step,
        fusion: f32,
    ) -> Result<(Forward, Result<Evaluation, String>), OptimizeError> {
        let forward = self.objective.forward(parameters, fusion);
        let view = self.view(crops, step);
        let evaluation = match bad_before_guidance(&parameters.to_tensors(), &forward) {
            Some(bad) => Err(bad.to_string()),
            None => {
                let shown = view.apply(&forward.picture.0);
                let guided = self.guidance.gradient(&shown, &view, step)?;
                self.gradient(parameters, &forward, &view, guided)
            }
        };
        Ok((forward, evaluation))
    }

    /// The state of the checkpoint, or that of the start; with the transport that it had.
    fn resume(&mut self) -> Result<State, OptimizeError> {
        let kept = match self.checkpoint {
            Some(path) => State::read(path, &self.settings, &self.start)?,
            None => None,
        };
        let state = kept.unwrap_or_else(|| State::new(self.start.clone()));
        if let Some(light) = &state.record_light {
            self.record(light.clone())?;
        }
        Ok(state)
    }

    /// Makes the fused light, as lobes, the light of both sets, with the momentum of the foreground.
    /// Where the sets still differ, lobes cannot express the fused map exactly; from here on the
    /// optimiser sees that difference and reduces it.
    fn join(&self, state: &mut State) {
        let (width, height) = self.objective.transport().environment_size();
        let light = Lighting::of(&state.parameters, width, height);
        let joined = Parameters::of_lobes(&light.lobes);
        state.parameters = Parameters {
            foreground: joined.foreground,
            shadow: joined.shadow,
            log_exposure: 0.0,
            ..state.parameters.clone()
        };
        for moments in [&mut state.adam.first, &mut state.adam.second] {
            *moments = std::mem::take(moments).twinned(&Parameters::TWINS);
        }
    }

    /// Records transport for the current light if the record samples it badly.
    fn record_again(&mut self, state: &mut State) -> Result<bool, OptimizeError> {
        let due = state.iteration > 0
            && state.iteration.is_multiple_of(RECORD_EVERY)
            && state.records < MOST_RECORDS
            && self.recorder.is_some();
        if !due {
            return Ok(false);
        }
        let fusion = self.settings.fusion(state.iteration);
        let light = self
            .objective
            .forward(&state.parameters, fusion)
            .fused
            .foreground;
        if light.iter().any(|t| !t.is_finite())
            || self.objective.transport().efficiency(&light) >= LEAST_EFFICIENCY
        {
            return Ok(false);
        }
        self.record(light.clone())?;
        state.record_light = Some(light);
        state.records += 1;
        Ok(true)
    }

    fn record(&mut self, light: Vec<Vec3>) -> Result<(), OptimizeError> {
        let Some(recorder) = &mut self.recorder else {
            return Ok(());
        };
        let (width, height) = self.objective.transport().environment_size();
        let map = EnvironmentMap::new(width, height, light)
            .map_err(|e| OptimizeError::Record(e.into()))?;
        self.objective.set_transport(recorder.record(&map)?);
        Ok(())
    }

    fn view(&self, crops: &CropSampler, step: Step) -> CropView {
        match self.guidance.framing() {
            Framing::Whole => CropView::whole(),
            Framing::Crops { side, scale } => {
                let crop = crops.crop(step.seed, step.iteration, scale);
                CropView::of(self.objective.transport().size(), crop, side)
            }
        }
    }

    /// The gradient of all parameters, or what was not finite on the way back.
    fn gradient(
        &self,
        parameters: &Parameters,
        forward: &Forward,
        view: &CropView,
        guided: Guided,
    ) -> Result<Evaluation, String> {
        if !guided.loss.is_finite() {
            return Err("loss of the guidance".into());
        }
        if guided.gradient.pixels().iter().any(|g| !g.is_finite()) {
            return Err("gradient of the guidance".into());
        }
        let on_picture = view.apply_vjp(guided.gradient);
        let gradient = self
            .objective
            .vjp(parameters, forward, &on_picture)
            .to_tensors();
        match gradient.first_not_finite() {
            Some(tensor) => Err(format!("gradient of {tensor}")),
            None => Ok(Evaluation {
                loss: guided.loss,
                timestep: guided.timestep,
                gradient,
            }),
        }
    }

    fn keep(&self, state: &State) -> Result<(), OptimizeError> {
        match self.checkpoint {
            Some(path) => state.write(path, &self.settings),
            None => Ok(()),
        }
    }

    fn interrupt(&self, state: &State) -> Result<Outcome, OptimizeError> {
        self.keep(state)?;
        Err(OptimizeError::Interrupted)
    }

    /// The fused light as lobes, and the picture under it.
    fn outcome(
        self,
        state: State,
        stopped_early: bool,
        watch: &mut dyn FnMut(Event) -> ControlFlow<()>,
    ) -> Result<Outcome, OptimizeError> {
        let (width, height) = self.objective.transport().environment_size();
        let lighting = Lighting::of(&state.parameters, width, height);
        let set: Vec<_> = lighting.lobes.iter().map(LobeParameters::of).collect();
        let delivered = Parameters {
            foreground: set.clone(),
            shadow: set,
            tone: state.parameters.tone,
            log_exposure: 0.0,
        };
        let picture = self.objective.forward(&delivered, 1.0).picture;
        let last = Event::Preview {
            iteration: state.iteration,
            picture: &picture,
        };
        if self.settings.preview_every > 0 && watch(last).is_break() {
            return self.interrupt(&state);
        }
        Ok(Outcome {
            lighting,
            tone: state.parameters.tone.curves(),
            picture,
            parameters: state.parameters,
            history: state.history,
            stopped_early,
        })
    }
}

/// Loss of the picture, and its gradient with respect to the parameters.
struct Evaluation {
    loss: f64,
    timestep: Option<f64>,
    gradient: Tensors,
}

fn bad_before_guidance(parameters: &Tensors, forward: &Forward) -> Option<&'static str> {
    parameters
        .first_not_finite()
        .or_else(|| forward.first_not_finite())
}

#[cfg(test)]
#[path = "optimization_tests.rs"]
mod tests;
