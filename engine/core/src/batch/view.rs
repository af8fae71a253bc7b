//! A batch as arrays: for the pool, which writes it slice by slice, and for readers.

use super::block::Block;
use super::frames::Frames;
use super::layout::{Dtype, Element, Layout};
use crate::envs::EnvSpec;

/// Which sections a batch has where there is a choice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contents {
    /// The frames; without them nothing is drawn.
    pub frames: Option<Frames>,
    /// The feature observation.
    pub features: bool,
    /// The last observation of episodes that same-step auto-reset ends.
    pub final_observation: bool,
}

/// The sections of an observation, which same-step auto-reset keeps a second time for the episode that ended.
fn observation_sections(spec: &EnvSpec, contents: Contents) -> Vec<(&'static str, Dtype, Vec<usize>)> {
    let mut sections = Vec::new();
    if let Some(frames) = contents.frames {
        sections.push(("observation", Dtype::Uint8, frames.shape()));
    }
    if spec.vector_observation > 0 {
        sections.push(("vector_observation", Dtype::Float32, vec![spec.vector_observation]));
    }
    if contents.features {
        sections.push(("features", Dtype::Float32, vec![spec.features.len()]));
    }
    if spec.ground_truth > 0 {
        sections.push(("ground_truth", Dtype::Float64, vec![spec.ground_truth]));
    }
    sections
}

/// The layout of a batch of `num_envs` environments.
pub fn batch_layout(spec: &EnvSpec, num_envs: usize, contents: Contents) -> Layout {
    let mut sections = observation_sections(spec, contents);
    sections.extend([
        ("reward", Dtype::Float64, vec![]),
        ("terminated", Dtype::Uint8, vec![]),
        ("truncated", Dtype::Uint8, vec![]),
        ("episode_return", Dtype::Float64, vec![]),
        ("episode_length", Dtype::Int32, vec![]),
        ("info", Dtype::Float64, vec![spec.info.len()]),
    ]);
    if contents.final_observation {
        sections.extend(observation_sections(spec, contents).into_iter().map(|(name, dtype, shape)| {
            let name = match name {
                "observation" => "final_observation",
                "vector_observation" => "final_vector_observation",
                "features" => "final_features",
                _ => "final_ground_truth",
            };
            (name, dtype, shape)
        }));
    }
    Layout::new(num_envs, sections).with_stamp()
}

/// Longest text of reset parameters in a message.
pub const OPTIONS_BYTES: usize = 16 * 1024;

/// Longest snapshot in a message. Most hold less than a kilobyte beside their reset parameters, one of 1,000 spotlights some 80;
/// reset parameters can ask for twice as many.
pub const SNAPSHOT_BYTES: usize = 256 * 1024;

/// The layout of the message that a trainer sends: `action` int32 (branches,) for a step; `reset` uint8 () and `seed` uint64 ()
/// for a reset, where `reset` is 0 (leave alone), 1 (start the next episode) or 2 (start an episode with `seed`); `options` for a
/// reset with other reset parameters, JSON text that runs on over the rows, at least [`OPTIONS_BYTES`] in all; `snapshot` for an
/// environment that is to go on from one, likewise.
pub fn action_layout(spec: &EnvSpec, num_envs: usize) -> Layout {
    let over_rows = |bytes: usize| vec![bytes.div_ceil(num_envs.max(1))];
    Layout::new(
        num_envs,
        [
            ("action", Dtype::Int32, vec![spec.action_space.branches().len()]),
            ("reset", Dtype::Uint8, vec![]),
            ("seed", Dtype::Uint64, vec![]),
            ("options", Dtype::Uint8, over_rows(OPTIONS_BYTES)),
            ("snapshot", Dtype::Uint8, over_rows(SNAPSHOT_BYTES)),
        ],
    )
}

/// Rows of one section for writing: one row for each environment, none wide where the batch lacks the section.
#[derive(Debug)]
pub struct RowsMut<'a, T> {
    numbers: &'a mut [T],
    width: usize,
}

impl<'a, T> RowsMut<'a, T> {
    /// The row of one environment; empty where the batch lacks the section.
    pub fn row(&mut self, env: usize) -> &mut [T] {
        &mut self.numbers[env * self.width..(env + 1) * self.width]
    }

    fn split_at(self, env: usize) -> (Self, Self) {
        let (left, right) = self.numbers.split_at_mut(env * self.width);
        (RowsMut { numbers: left, width: self.width }, RowsMut { numbers: right, width: self.width })
    }
}

macro_rules! batch_mut {
    ($($field:ident: $element:ty),* $(,)?) => {
        /// A batch, or the part of it that belongs to consecutive environments, for writing.
        #[derive(Debug)]
        pub struct BatchMut<'a> {
            $(pub $field: RowsMut<'a, $element>,)*
        }

        impl<'a> BatchMut<'a> {
            /// The whole batch in `blocks`, which must be as long as `layout` says; `None` if it is shorter.
            pub fn new(layout: &Layout, blocks: &'a mut [Block]) -> Option<Self> {
                if blocks.len() < layout.blocks() {
                    return None;
                }
                let mut rest: &mut [u8] = bytemuck::cast_slice_mut(blocks);
                let mut at = 0;
                $(let mut $field = RowsMut { numbers: &mut [] as &mut [$element], width: 0 };)*
                for section in layout.sections() {
                    let bytes = layout.section_bytes(section);
                    let (_, tail) = rest.split_at_mut(section.offset - at);
                    let (mine, tail) = tail.split_at_mut(bytes);
                    at = section.offset + bytes;
                    rest = tail;
                    match section.name.as_str() {
                        $(stringify!($field) if section.dtype == <$element as Element>::DTYPE => {
                            $field = RowsMut { numbers: bytemuck::cast_slice_mut(mine), width: section.width() };
                        })*
                        _ => {}
                    }
                }
                Some(BatchMut { $($field),* })
            }

            /// Divides the batch before environment `env`.
            pub fn split_at(self, env: usize) -> (Self, Self) {
                $(let $field = self.$field.split_at(env);)*
                (BatchMut { $($field: $field.0),* }, BatchMut { $($field: $field.1),* })
            }
        }
    };
}

batch_mut! {
    observation: u8,
    vector_observation: f32,
    features: f32,
    ground_truth: f64,
    reward: f64,
    terminated: u8,
    truncated: u8,
    episode_return: f64,
    episode_length: i32,
    info: f64,
    final_observation: u8,
    final_vector_observation: f32,
    final_features: f32,
    final_ground_truth: f64,
}

/// A batch for reading. Each array has `num_envs` rows after each other; empty where the batch lacks the section.
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a> {
    layout: &'a Layout,
    blocks: &'a [Block],
}

impl<'a> Batch<'a> {
    /// The batch in `blocks`.
    pub fn new(layout: &'a Layout, blocks: &'a [Block]) -> Self {
        Batch { layout, blocks }
    }

    /// Where the arrays lie.
    pub fn layout(&self) -> &'a Layout {
        self.layout
    }

    /// The whole batch, sections and the padding between them.
    pub fn bytes(&self) -> &'a [u8] {
        bytemuck::cast_slice(&self.blocks[..self.blocks.len().min(self.layout.section_blocks())])
    }

    /// All numbers of a section; empty if the batch has none of that name and type.
    pub fn section<T: Element>(&self, name: &str) -> &'a [T] {
        self.layout.read(self.blocks, name)
    }

    /// Frames, uint8 (num_envs, 84, 84, 3), indexed \[x\]\[y\]\[channel\], or as [`Frames`] says.
    pub fn observation(&self) -> &'a [u8] {
        self.section("observation")
    }

    /// float64 (num_envs,).
    pub fn reward(&self) -> &'a [f64] {
        self.section("reward")
    }

    /// 1 where this step ended the episode, uint8 (num_envs,).
    pub fn terminated(&self) -> &'a [u8] {
        self.section("terminated")
    }

    /// Sum of the running episode's rewards, float64 (num_envs,).
    pub fn episode_return(&self) -> &'a [f64] {
        self.section("episode_return")
    }

    /// Steps of the running episode, int32 (num_envs,).
    pub fn episode_length(&self) -> &'a [i32] {
        self.section("episode_length")
    }
}
