//! The tables of sections: the single source for layouts, their checks, the views of a batch, and this documentation.

use std::fmt;

use super::dtype::{Dtype, Element, Sealed};
use super::frames::Frames;
use crate::envs::{ActionSpace, EnvSpec, StatePart};

/// Maximum length of a message's reset parameters, in bytes of JSON text.
pub const OPTIONS_BYTES: usize = 16 * 1024;

/// Maximum length of a snapshot in a message, in bytes. Most snapshots take less than a kilobyte more than their reset
/// parameters; one with 1,000 spotlights takes about 80 kilobytes, and reset parameters allow twice as many.
pub const SNAPSHOT_BYTES: usize = 256 * 1024;

/// The sections that a batch or a message may have: [`BatchSection`] or [`ActionSection`].
///
/// A [`Layout`](super::Layout) describes where each of them is. The trait is sealed: other crates cannot implement it.
pub trait SectionTable: Sealed + Copy + Eq + fmt::Debug + fmt::Display + 'static {
    /// All sections, in memory order.
    const ALL: &'static [Self];

    /// Blocks after the last section that belong to the writer.
    const STAMP_BLOCKS: usize;

    /// The section's name in JSON and in Python.
    fn name(self) -> &'static str;

    /// The section's number type.
    fn dtype(self) -> Dtype;

    /// The shapes that one environment's row may have.
    fn row(self) -> RowShape;

    /// Whether every layout has the section.
    fn is_required(self) -> bool;

    /// The section with this name, if there is one.
    fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|section| section.name() == name)
    }
}

/// The shapes that one environment's row of a section may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowShape {
    /// One number: `()`.
    Scalar,
    /// One number that is 0 or 1: `()`. Python shows it as `bool`.
    Flag,
    /// Several numbers: `(k,)`.
    Vector,
    /// Frames as [`Frames`] describes them: 2 to 4 dimensions.
    Frames,
    /// One byte string stored across all rows: `(k,)`, at least this many bytes in all.
    Bytes(usize),
}

impl RowShape {
    /// Whether a row may have that shape. The total size of a [`RowShape::Bytes`] section is not checked here.
    pub(super) fn admits(self, shape: &[usize]) -> bool {
        match self {
            RowShape::Scalar | RowShape::Flag => shape.is_empty(),
            RowShape::Vector | RowShape::Bytes(_) => shape.len() == 1,
            RowShape::Frames => (2..=4).contains(&shape.len()),
        }
    }
}

impl fmt::Display for RowShape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            RowShape::Scalar | RowShape::Flag => "()",
            RowShape::Vector | RowShape::Bytes(_) => "(k,)",
            RowShape::Frames => "a frame's shape of 2 to 4 dimensions",
        })
    }
}

macro_rules! presence {
    (required) => {
        true
    };
    (optional) => {
        false
    };
}

/// Defines the enum of a table, with the table as its documentation.
macro_rules! section_table {
    (
        $(#[$meta:meta])*
        $table:ident, $stamp_blocks:literal;
        $($variant:ident $name:ident: $element:ident, $row:ident $(($bytes:ident))?, $presence:ident, $meaning:literal;)*
    ) => {
        $(#[$meta])*
        ///
        /// | section | number type | row | contents |
        /// | --- | --- | --- | --- |
        $(#[doc = concat!(
            "| `", stringify!($name), "` | `", stringify!($element), "` | [`", stringify!($row), "`](RowShape::", stringify!($row), ") | ",
            $meaning, " |"
        )])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum $table {
            $(
                #[doc = concat!(
                    "`", stringify!($name), "`, `", stringify!($element), "` [`", stringify!($row), "`](RowShape::", stringify!($row), "): ",
                    $meaning, "."
                )]
                $variant,
            )*
        }

        impl Sealed for $table {}

        impl SectionTable for $table {
            const ALL: &'static [Self] = &[$($table::$variant),*];
            const STAMP_BLOCKS: usize = $stamp_blocks;

            fn name(self) -> &'static str {
                match self {
                    $($table::$variant => stringify!($name),)*
                }
            }

            fn dtype(self) -> Dtype {
                match self {
                    $($table::$variant => <$element as Element>::DTYPE,)*
                }
            }

            fn row(self) -> RowShape {
                match self {
                    $($table::$variant => RowShape::$row $(($bytes))?,)*
                }
            }

            fn is_required(self) -> bool {
                match self {
                    $($table::$variant => presence!($presence),)*
                }
            }
        }

        impl fmt::Display for $table {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}

/// Calls another macro with the given tokens, followed by the table of a batch's sections.
macro_rules! batch_sections {
    ($macro:ident! $($before:tt)*) => {
        $macro! {
            $($before)*
            Observation observation: u8, Frames, optional,
                "the frames; absent if frames are turned off";
            VectorObservation vector_observation: f32, Vector, optional,
                "the vector observation, 0 to 1; only for ids that have one";
            Features features: f32, Vector, optional,
                "the content of the frame as numbers, in the order of the environment's specification; on request";
            GroundTruth ground_truth: f64, Vector, optional,
                "the ground truth, in the order of the environment's specification; only for ids that have one";
            State state: f32, Vector, optional,
                "the Markov state, in the order of the environment's specification; on request, only for ids that tell it";
            Reward reward: f64, Scalar, required,
                "reward of this step";
            Terminated terminated: u8, Flag, required,
                "1 if the task ended the episode in this step";
            Truncated truncated: u8, Flag, required,
                "1 if something outside the task ended the episode in this step, such as a step limit";
            EpisodeReturn episode_return: f64, Scalar, required,
                "sum of the running episode's rewards, including this step";
            EpisodeLength episode_length: i32, Scalar, required,
                "number of steps of the running episode, including this step";
            Info info: f64, Vector, required,
                "the final infos besides `reward` and `length`, in the order of the environment's specification; 0 in steps that end no episode";
            FinalObservation final_observation: u8, Frames, optional,
                "`observation` of an episode that same-step autoreset ended in this step, on request; other rows are unspecified";
            FinalVectorObservation final_vector_observation: f32, Vector, optional,
                "`vector_observation` of an episode that same-step autoreset ended in this step, on request; other rows are unspecified";
            FinalFeatures final_features: f32, Vector, optional,
                "`features` of an episode that same-step autoreset ended in this step, on request; other rows are unspecified";
            FinalGroundTruth final_ground_truth: f64, Vector, optional,
                "`ground_truth` of an episode that same-step autoreset ended in this step, on request; other rows are unspecified";
            FinalState final_state: f32, Vector, optional,
                "`state` of an episode that same-step autoreset ended in this step, on request; other rows are unspecified";
        }
    };
}
pub(super) use batch_sections;

batch_sections! { section_table!
    /// A section of a batch, the memory that a step of a group of environments writes.
    ///
    /// In same-step autoreset, `observation`, `vector_observation`, `features`, `ground_truth` and `state` belong to the new episode in a
    /// step that ends one, while reward, flags, `episode_*` and `info` belong to the episode that ended.
    BatchSection, 1;
}

section_table! {
    /// A section of the message that a trainer sends to an engine. All are present; the message's header says which are used.
    ActionSection, 0;
    Action action: i32, Vector, required,
        "for a step, one number for each branch of the action space";
    Reset reset: u8, Scalar, required,
        "for a reset of some environments: 0 does not reset the environment, 1 starts its next episode, 2 starts an episode with `seed`; for a query of running episodes: 0 omits the environment";
    Seed seed: u64, Scalar, required,
        "for a reset of some environments: the seed where `reset` is 2";
    Options options: u8, Bytes(OPTIONS_BYTES), required,
        "for a reset with other reset parameters: one JSON text stored across all rows, at least [`OPTIONS_BYTES`] in all";
    Snapshot snapshot: u8, Bytes(SNAPSHOT_BYTES), required,
        "for restoring an environment: its snapshot; for setting the options of next episodes: their JSON text; one byte string stored across all rows, at least [`SNAPSHOT_BYTES`] in all";
}

/// Which optional sections a batch has. The default has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Contents {
    /// Format of the frames; `None` omits them, and nothing is drawn.
    pub frames: Option<Frames>,
    /// Whether to include the feature observation.
    pub features: bool,
    /// Whether to include the Markov state.
    pub state: bool,
    /// Whether to include the `final_*` sections, for same-step autoreset.
    pub final_observation: bool,
}

impl BatchSection {
    /// Shape of the section's row in a batch of that environment; `None` if the batch lacks the section.
    pub(super) fn row_shape(self, spec: &EnvSpec, contents: Contents) -> Option<Vec<usize>> {
        let columns = |count: usize| (count > 0).then(|| vec![count]);
        let final_of = |section: BatchSection| section.row_shape(spec, contents).filter(|_| contents.final_observation);
        match self {
            BatchSection::Observation => contents.frames.zip(spec.frame).map(|(frames, frame)| frames.shape(frame)),
            BatchSection::VectorObservation => columns(spec.vector_observation),
            BatchSection::Features => {
                columns(spec.features.len()).filter(|_| contents.features || spec.frame.is_none())
            }
            BatchSection::GroundTruth => columns(spec.ground_truth.len()),
            BatchSection::State => {
                columns(spec.markov_state.iter().map(StatePart::width).sum()).filter(|_| contents.state)
            }
            BatchSection::Reward
            | BatchSection::Terminated
            | BatchSection::Truncated
            | BatchSection::EpisodeReturn
            | BatchSection::EpisodeLength => Some(vec![]),
            BatchSection::Info => Some(vec![spec.info.len()]),
            BatchSection::FinalObservation => final_of(BatchSection::Observation),
            BatchSection::FinalVectorObservation => final_of(BatchSection::VectorObservation),
            BatchSection::FinalFeatures => final_of(BatchSection::Features),
            BatchSection::FinalGroundTruth => final_of(BatchSection::GroundTruth),
            BatchSection::FinalState => final_of(BatchSection::State),
        }
    }
}

impl ActionSection {
    /// Shape of the section's row in a message for `num_envs` environments, which is not 0.
    pub(super) fn row_shape(self, space: &ActionSpace, num_envs: usize) -> Vec<usize> {
        match (self, self.row()) {
            (_, RowShape::Bytes(bytes)) => vec![bytes.div_ceil(num_envs)],
            (ActionSection::Action, _) => vec![space.width()],
            _ => vec![],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toy::toys;

    /// Each `final_*` section has the number type and the shape of its original.
    #[test]
    fn final_sections_equal_their_originals() {
        for spec in toys().specs() {
            let contents =
                Contents { frames: Some(Frames::default()), features: true, state: true, final_observation: true };
            for section in BatchSection::ALL {
                let Some(original) = section.name().strip_prefix("final_") else { continue };
                let original = BatchSection::from_name(original).unwrap();
                assert_eq!(section.dtype(), original.dtype());
                assert_eq!(section.row(), original.row());
                assert_eq!(section.row_shape(spec, contents), original.row_shape(spec, contents));
                assert_eq!(section.row_shape(spec, Contents { final_observation: false, ..contents }), None);
            }
        }
    }
}
