//! A batch as arrays: [`Batch`] for readers, and [`BatchMut`] for the pool, which writes it in parts.

use super::block::Block;
use super::dtype::Element;
use super::layout::Layout;
use super::sections::{BatchSection, batch_sections};

/// Rows of one section for writing, one for each environment. Where the batch lacks the section, the rows are empty.
#[derive(Debug)]
pub(crate) struct RowsMut<'a, T> {
    numbers: &'a mut [T],
    width: usize,
}

impl<'a, T> RowsMut<'a, T> {
    /// The row of one environment; empty where the batch lacks the section.
    ///
    /// # Panics
    ///
    /// If there are not so many environments.
    pub fn row(&mut self, env: usize) -> &mut [T] {
        &mut self.numbers[env * self.width..(env + 1) * self.width]
    }

    fn split_at(self, env: usize) -> (Self, Self) {
        let (left, right) = self.numbers.split_at_mut(env * self.width);
        (RowsMut { numbers: left, width: self.width }, RowsMut { numbers: right, width: self.width })
    }
}

macro_rules! batch_view {
    ($($variant:ident $field:ident: $element:ident, $row:ident, $presence:ident, $meaning:literal;)*) => {
        /// A batch, or the part of it that belongs to consecutive environments, for writing.
        #[derive(Debug)]
        pub(crate) struct BatchMut<'a> {
            $(
                #[doc = concat!("Rows of `", stringify!($field), "`: ", $meaning, ".")]
                pub $field: RowsMut<'a, $element>,
            )*
        }

        impl<'a> BatchMut<'a> {
            /// The batch in `blocks`; `None` if they are fewer than the layout needs.
            pub fn new(layout: &Layout, blocks: &'a mut [Block]) -> Option<Self> {
                if blocks.len() < layout.blocks() {
                    return None;
                }
                let mut rest: &mut [u8] = bytemuck::cast_slice_mut(blocks);
                let mut at = 0;
                $(let mut $field = RowsMut { numbers: &mut [] as &mut [$element], width: 0 };)*
                for section in layout.sections() {
                    let (_, tail) = rest.split_at_mut(section.offset() - at);
                    let (numbers, tail) = tail.split_at_mut(section.bytes());
                    at = section.offset() + section.bytes();
                    rest = tail;
                    match section.name() {
                        $(BatchSection::$variant => {
                            $field = RowsMut { numbers: bytemuck::cast_slice_mut(numbers), width: section.width() };
                        })*
                    }
                }
                Some(BatchMut { $($field),* })
            }

            /// Divides the batch before environment `env`.
            ///
            /// # Panics
            ///
            /// If there are not so many environments.
            pub fn split_at(self, env: usize) -> (Self, Self) {
                $(let $field = self.$field.split_at(env);)*
                (BatchMut { $($field: $field.0),* }, BatchMut { $($field: $field.1),* })
            }
        }

        /// The sections as slices of `num_envs` rows after each other; [`BatchSection`] lists the shapes. A slice is empty where
        /// the batch lacks the section.
        impl<'a> Batch<'a> {
            $(
                #[doc = concat!("Section `", stringify!($field), "`: ", $meaning, ".")]
                pub fn $field(&self) -> &'a [$element] {
                    self.section(BatchSection::$variant)
                }
            )*
        }
    };
}

batch_sections! { batch_view! }

/// A batch for reading.
///
/// ```
/// use endless_gym_core::batch::{Batch, BatchSection, zeroed};
/// use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
///
/// let mut pool = Pool::new(&PoolConfig::new("MysteryPath-Grid-v0", 4), &Threads::new(1)?)?;
/// let mut blocks = zeroed(pool.layout().blocks());
/// pool.reset(ResetRequest::Seed(7), &mut blocks)?;
///
/// let batch = Batch::new(pool.layout(), &blocks);
/// assert_eq!(batch.observation().len(), 4 * 84 * 84 * 3);
/// assert_eq!(batch.reward(), [0.0; 4]);
/// assert!(batch.features().is_empty());
/// // The number type has to be the section's.
/// assert_eq!(batch.section::<u8>(BatchSection::Terminated), [0; 4]);
/// assert!(batch.section::<f32>(BatchSection::Terminated).is_empty());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a> {
    layout: &'a Layout,
    blocks: &'a [Block],
}

impl<'a> Batch<'a> {
    /// The batch in `blocks`. Sections that lie beyond them are empty.
    pub fn new(layout: &'a Layout, blocks: &'a [Block]) -> Self {
        Batch { layout, blocks }
    }

    /// Where the sections lie.
    pub fn layout(&self) -> &'a Layout {
        self.layout
    }

    /// All sections and the padding between them, without the writer's stamp.
    pub fn bytes(&self) -> &'a [u8] {
        bytemuck::cast_slice(&self.blocks[..self.blocks.len().min(self.layout.section_blocks())])
    }

    /// All numbers of a section; empty if the batch lacks the section or if `T` is not its type.
    pub fn section<T: Element>(&self, section: BatchSection) -> &'a [T] {
        self.layout.read(self.blocks, section)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::{Value as Json, json};

    use super::super::block::zeroed;
    use super::super::frames::Frames;
    use super::super::layout::{ActionLayout, action_layout, batch_layout};
    use super::super::sections::{Contents, SectionTable};
    use super::*;
    use crate::envs;

    /// A number that a forger would try.
    fn numbers() -> impl Strategy<Value = Json> {
        prop_oneof![
            (0..9_u64).prop_map(Json::from),
            (0..400_u64).prop_map(|blocks| Json::from(blocks * 64)),
            (0..64_u32, -1..2_i64).prop_map(|(bit, more)| Json::from((1_u64 << bit).wrapping_add_signed(more))),
            Just(json!(-1)),
            Just(json!(0.5)),
        ]
    }

    fn values() -> impl Strategy<Value = Json> {
        let names = BatchSection::ALL.iter().map(|section| Json::from(section.name())).collect::<Vec<_>>();
        let dtypes = ["uint8", "int32", "uint64", "float32", "float64", "int8"].map(Json::from).to_vec();
        prop_oneof![
            4 => numbers(),
            2 => prop::collection::vec(numbers(), 0..10).prop_map(Json::Array),
            1 => prop::sample::select(names),
            1 => prop::sample::select(dtypes),
            1 => Just(Json::Null),
        ]
    }

    /// Every place in a layout's JSON.
    fn pointers(json: &Json, at: String, to: &mut Vec<String>) {
        to.push(at.clone());
        match json {
            Json::Array(items) => {
                items.iter().enumerate().for_each(|(index, item)| pointers(item, format!("{at}/{index}"), to));
            }
            Json::Object(fields) => fields.iter().for_each(|(name, field)| pointers(field, format!("{at}/{name}"), to)),
            _ => {}
        }
    }

    /// Replaces, removes, doubles and swaps parts.
    fn forge(mut json: Json, changes: &[(prop::sample::Index, u8, Json)]) -> Json {
        for (index, kind, value) in changes {
            let mut places = Vec::new();
            pointers(&json, String::new(), &mut places);
            let place = index.get(&places).clone();
            let Some(found) = json.pointer_mut(&place) else { continue };
            match (found, kind % 5) {
                (Json::Array(items), 0) if !items.is_empty() => {
                    let at = index.index(items.len());
                    items.remove(at);
                }
                (Json::Array(items), 1) if !items.is_empty() => {
                    let item = index.get(items).clone();
                    items.push(item);
                }
                (Json::Array(items), 2) if !items.is_empty() => {
                    let at = index.index(items.len());
                    items.swap(0, at);
                }
                (Json::Number(number), 0..=2) => {
                    let change = [1_i64, -1, 64, -64][usize::from(kind / 5 % 4)];
                    if let Some(changed) = number.as_u64().and_then(|number| number.checked_add_signed(change)) {
                        *number = changed.into();
                    }
                }
                (found, _) => *found = value.clone(),
            }
        }
        json
    }

    /// Reads, writes and divides a batch of that layout, and one that is too short.
    fn use_all(layout: &Layout) -> Result<(), TestCaseError> {
        prop_assert!(BatchMut::new(layout, &mut zeroed(layout.blocks().min(1 << 16) - 1)).is_none());
        if layout.blocks() > 1 << 16 {
            return Ok(());
        }
        let mut blocks = zeroed(layout.blocks());
        let (_, mut right) = BatchMut::new(layout, &mut blocks).unwrap().split_at(layout.num_envs() - 1);
        right.reward.row(0)[0] = 1.5;
        right.terminated.row(0)[0] = 1;
        right.truncated.row(0)[0] = 1;
        right.episode_return.row(0)[0] = 2.5;
        right.episode_length.row(0)[0] = 3;
        right.info.row(0).fill(4.0);
        right.observation.row(0).fill(5);
        right.final_ground_truth.row(0).fill(6.0);
        let batch = Batch::new(layout, &blocks);
        prop_assert_eq!(batch.reward().last(), Some(&1.5));
        prop_assert_eq!(batch.episode_length().last(), Some(&3));
        prop_assert_eq!(batch.bytes().len(), (layout.blocks() - 1) * 64);
        for section in layout.sections() {
            let short = &blocks[..layout.blocks() / 2];
            prop_assert!(layout.read::<u8>(short, section.name()).len() <= section.bytes());
            prop_assert!(layout.write::<f64>(&mut zeroed(1), section.name()).len() <= 8);
        }
        Ok(())
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2_000, ..ProptestConfig::default() })]

        /// Whatever deserialises can be read, written and divided.
        #[test]
        fn forged_layouts_are_refused_or_usable(
            id in 0..9_usize,
            num_envs in 1..5_usize,
            options in 0..8_u8,
            changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), values()), 1..5),
        ) {
            let spec = envs::specs().nth(id).unwrap();
            let contents = Contents {
                frames: (options & 1 != 0).then(Frames::default),
                features: options & 2 != 0,
                final_observation: options & 4 != 0,
            };
            let layout = batch_layout(spec, num_envs, contents).unwrap();
            use_all(&layout)?;
            if let Ok(layout) = serde_json::from_value::<Layout>(forge(serde_json::to_value(&layout).unwrap(), &changes)) {
                use_all(&layout)?;
            }
            let layout = action_layout(spec, num_envs).unwrap();
            let json = forge(serde_json::to_value(&layout).unwrap(), &changes);
            if let Ok(layout) = serde_json::from_value::<ActionLayout>(json)
                && layout.blocks() <= 1 << 16
            {
                let mut blocks = zeroed(layout.blocks());
                for section in layout.sections() {
                    layout.write::<u8>(&mut blocks, section.name()).fill(1);
                    layout.write::<i32>(&mut blocks, section.name()).fill(1);
                }
            }
        }
    }
}
