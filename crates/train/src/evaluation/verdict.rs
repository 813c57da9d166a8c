//! What the scores of a set say, in a sentence.

use super::markdown::grouped;
use super::report::{EvaluationReport, SetReport, SetScores};

/// What a reader may do about a model that is not better than simple baselines.
const ADVICE: &str = "more data or a longer training may help";

/// Where a model was trained on so many windows for each one that the baseline knows, the baseline is not as strong as it could be.
const WINDOWS_FOR_ONE: usize = 10;

impl EvaluationReport {
    /// What the scores of a set say: whether the model is better than the strongest baseline, by how much, what to do if it is not, and
    /// what makes the skill too high. `None` if the set was skipped.
    #[doc(hidden)]
    #[must_use]
    pub fn verdict(&self, set: &SetReport) -> Option<String> {
        let scores = set.outcome.scores()?;
        let sentences = [Some(scores.verdict()), scores.seen_frames(), self.weak_baseline()];
        Some(sentences.into_iter().flatten().collect::<Vec<_>>().join("; "))
    }

    /// That the nearest training windows, often the strongest baseline, know much less than the model.
    fn weak_baseline(&self) -> Option<String> {
        let known = self.model.trained_on.windows;
        match &self.nearest_windows {
            None => {
                Some("there is no baseline of nearest training windows here, so the skill may be too high".to_owned())
            }
            Some(nearest) if nearest.searched.saturating_mul(WINDOWS_FOR_ONE) < known => Some(format!(
                "the baseline of nearest training windows knows {}, and the model was trained on {}, so the skill may be too high",
                grouped(nearest.searched as u64),
                grouped(known as u64)
            )),
            Some(_) => None,
        }
    }
}

impl SetScores {
    fn verdict(&self) -> String {
        let (mean, interval) = (self.skill.skill.mean, self.skill.mean_interval);
        let baseline = format!("the strongest baseline ({})", self.skill.best_mean_baseline.label());
        let percent = 100.0 * mean.abs();
        let contains_0 = interval.is_some_and(|interval| (interval.low..=interval.high).contains(&0.0));
        let verdict = match mean {
            // One group has no interval.
            _ if interval.is_none() && percent < 0.5 => format!("about as good as {baseline}; {ADVICE}"),
            _ if contains_0 => {
                format!("about as good as {baseline}: the interval of the skill contains 0; {ADVICE}")
            }
            0.0.. => format!("better than {baseline} by {percent:.0} %"),
            ..-1.0 => {
                let times = 1.0 - mean;
                format!("worse than {baseline}: its error is {times:.1} times as large; {ADVICE}")
            }
            _ => format!("worse than {baseline} by {percent:.0} %; {ADVICE}"),
        };
        self.with_doubt(verdict)
    }

    /// That frames of the windows were in the training, if they were.
    fn seen_frames(&self) -> Option<String> {
        let frames = self.frames_of_training.filter(|frames| frames.were_trained_on())?;
        Some(format!(
            "{} of {} sampled frames were in the model's training, so this does not test what it never saw",
            frames.seen, frames.sampled
        ))
    }

    /// The same, with what makes it doubtful if there is something.
    fn with_doubt(&self, verdict: String) -> String {
        if self.intervals_are_reliable {
            return verdict;
        }
        let is_one = self.trials.or(self.blocks) == Some(1);
        let are = if is_one { "is" } else { "are" };
        format!("{verdict}; {} {are} too few to be sure", self.groups())
    }

    /// The skill against the baselines that know nothing of the data set, for a model that was not trained on it.
    #[doc(hidden)]
    #[must_use]
    pub fn verdict_against_unfitted(&self) -> Option<String> {
        let skill = self.skill_against_unfitted.as_ref()?;
        let interval = skill.mean_interval.map_or_else(String::new, |interval| {
            format!(" (95 % interval: {:.3} … {:.3})", interval.low, interval.high)
        });
        Some(self.with_doubt(format!(
            "against baselines that know nothing of this data set, the skill is {:.3}{interval}; the strongest of them is {}",
            skill.skill.mean,
            skill.best_mean_baseline.label()
        )))
    }

    /// What the windows come from: `12 trials`, `3 blocks`.
    fn groups(&self) -> String {
        let (count, unit) = match (self.trials, self.blocks) {
            (Some(trials), _) => (trials, "trial"),
            (None, blocks) => (blocks.unwrap_or(0), "block"),
        };
        format!("{count} {unit}{}", if count == 1 { "" } else { "s" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::bootstrap::{Bootstrap, Interval};
    use crate::evaluation::report::FramesOfTraining;
    use foreframe_core::types::Seed;

    fn verdict(mean: f64, interval: Option<(f64, f64)>, is_reliable: bool) -> String {
        let bootstrap = Bootstrap {
            samples: 1,
            seed: Seed(0),
        };
        let mut scores = SetScores::new(&[], &[], &bootstrap, true);
        scores.skill.skill.mean = mean;
        scores.skill.mean_interval = interval.map(|(low, high)| Interval { low, high });
        scores.intervals_are_reliable = is_reliable;
        scores.verdict()
    }

    #[test]
    fn frames_of_the_training_are_told() {
        let bootstrap = Bootstrap {
            samples: 1,
            seed: Seed(0),
        };
        let mut scores = SetScores::new(&[], &[], &bootstrap, true);
        let told = |scores: &SetScores| scores.seen_frames();
        assert_eq!(told(&scores), None);
        scores.frames_of_training = Some(FramesOfTraining { sampled: 9, seen: 1 });
        assert_eq!(told(&scores), None);
        scores.frames_of_training = Some(FramesOfTraining { sampled: 9, seen: 7 });
        let expected = "7 of 9 sampled frames were in the model's training, so this does not test what it never saw";
        assert_eq!(told(&scores).as_deref(), Some(expected));
    }

    #[test]
    fn the_second_skill_is_told_of_a_model_that_has_one() {
        let bootstrap = Bootstrap {
            samples: 1,
            seed: Seed(0),
        };
        let mut scores = SetScores::new(&[], &[], &bootstrap, true);
        assert_eq!(scores.verdict_against_unfitted(), None);
        scores.skill_against_unfitted = Some(scores.skill.clone());
        let told = scores.verdict_against_unfitted().unwrap();
        let end = "the strongest of them is copy last frame; 0 blocks are too few to be sure";
        assert!(told.ends_with(end), "{told}");
    }

    #[test]
    fn a_verdict_follows_from_the_skill_and_its_interval() {
        for (mean, interval, expected) in [
            (
                0.48,
                (0.44, 0.53),
                "better than the strongest baseline (copy last frame) by 48 %",
            ),
            (
                -0.15,
                (-0.2, -0.1),
                "worse than the strongest baseline (copy last frame) by 15 %; more data or a longer training may help",
            ),
            (
                -1.46,
                (-1.63, -1.31),
                "worse than the strongest baseline (copy last frame): its error is 2.5 times as large; more data or a longer training \
                 may help",
            ),
            (
                0.04,
                (-0.18, 0.28),
                "about as good as the strongest baseline (copy last frame): the interval of the skill contains 0; more data or \
                 a longer training may help",
            ),
        ] {
            assert_eq!(verdict(mean, Some(interval), true), expected);
        }
        let equal = verdict(0.0, None, false);
        assert_eq!(
            equal,
            "about as good as the strongest baseline (copy last frame); more data or a longer training may help; 0 blocks are too \
             few to be sure"
        );
        let unsure = verdict(0.5, None, false);
        assert!(unsure.ends_with("by 50 %; 0 blocks are too few to be sure"), "{unsure}");
    }
}
