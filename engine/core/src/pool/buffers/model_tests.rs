//! Checks that a current buffer shows the scenes of its record, after every short sequence of events and after long random
//! ones.

use proptest::prelude::*;
use proptest::test_runner::contextualize_config;

use super::*;
use crate::batch::{Contents, batch_layout, zeroed};
use crate::toy::toys;

/// What happens to the buffers of two pools.
#[derive(Clone, Copy, Debug)]
enum Event {
    /// A pool writes into a buffer.
    Write { pool: usize, buffer: usize },
    /// A write ends early, by an error or a panic: some pixels and scenes are old, some are new.
    Interrupted { pool: usize, buffer: usize },
    /// The memory of a buffer is copied over another's.
    Copy { from: usize, to: usize },
    /// The frames are changed from outside, with a call of `forget_frames`.
    Forget { buffer: usize },
}

/// The first number of each buffer stands for its pixels, and each pool's drawn scenes are such numbers.
struct Model {
    layout: Layout,
    pools: [(Buffers, Vec<u64>); 2],
    buffers: Vec<Vec<Block>>,
    drawings: u64,
}

impl Model {
    fn new(layout: &Layout, buffers: usize) -> Self {
        let pools = [1, 3].map(|identity| (Buffers::new(identity), Vec::new()));
        Model { layout: layout.clone(), pools, buffers: vec![zeroed(layout.blocks()); buffers], drawings: 0 }
    }

    fn pixels(&mut self, buffer: usize) -> &mut u64 {
        &mut bytemuck::cast_slice_mut(&mut self.buffers[buffer])[0]
    }

    fn apply(&mut self, event: Event) {
        self.drawings += 1;
        let new = self.drawings;
        match event {
            Event::Write { pool, buffer } => {
                let record = self.begin(pool, buffer);
                *self.pixels(buffer) = new;
                self.pools[pool].1[record.index] = new;
                self.pools[pool].0.finish(record, &self.layout, &mut self.buffers[buffer]);
            }
            Event::Interrupted { pool, buffer } => {
                let record = self.begin(pool, buffer);
                *self.pixels(buffer) = u64::MAX - new;
                self.pools[pool].1[record.index] = new;
            }
            Event::Copy { from, to } => self.buffers[to] = self.buffers[from].clone(),
            Event::Forget { buffer } => {
                self.layout.forget_frames(&mut self.buffers[buffer]);
                *self.pixels(buffer) = u64::MAX - new;
            }
        }
    }

    fn begin(&mut self, pool: usize, buffer: usize) -> Buffer {
        let pixels = *self.pixels(buffer);
        let (buffers, scenes) = &mut self.pools[pool];
        let record = buffers.begin(&self.layout, &mut self.buffers[buffer]);
        scenes.resize(scenes.len().max(record.index + 1), 0);
        assert!(!record.current || scenes[record.index] == pixels, "a current buffer shows other scenes");
        assert_eq!(Stamp::read(&self.layout, &self.buffers[buffer]), Stamp::default());
        record
    }
}

fn layout() -> Layout {
    let contents = Contents::default();
    batch_layout(toys().specs().next().unwrap(), 1, contents).unwrap()
}

#[test]
fn current_buffers_show_their_records_after_every_short_sequence() {
    const LENGTH: u32 = 5;
    let pairs = [(0, 0), (0, 1), (1, 0), (1, 1)];
    let events: Vec<Event> = pairs
        .iter()
        .flat_map(|&(pool, buffer)| [Event::Write { pool, buffer }, Event::Interrupted { pool, buffer }])
        .chain([Event::Copy { from: 0, to: 1 }, Event::Copy { from: 1, to: 0 }])
        .chain([0, 1].map(|buffer| Event::Forget { buffer }))
        .collect();
    let layout = layout();
    for sequence in 0..events.len().pow(LENGTH) {
        let mut model = Model::new(&layout, 2);
        for position in 0..LENGTH {
            model.apply(events[sequence / events.len().pow(position) % events.len()]);
        }
    }
}

fn event() -> impl Strategy<Value = Event> {
    let buffer = || 0..MAX_BUFFERS + 4;
    prop_oneof![
        6 => (0..2_usize, buffer()).prop_map(|(pool, buffer)| Event::Write { pool, buffer }),
        2 => (0..2_usize, buffer()).prop_map(|(pool, buffer)| Event::Interrupted { pool, buffer }),
        2 => (buffer(), buffer()).prop_map(|(from, to)| Event::Copy { from, to }),
        1 => buffer().prop_map(|buffer| Event::Forget { buffer }),
    ]
}

proptest! {
    #![proptest_config(contextualize_config(ProptestConfig::with_cases(200)))]

    #[test]
    fn current_buffers_show_their_records_with_more_buffers_than_records(
        events in prop::collection::vec(event(), 1..400),
    ) {
        let mut model = Model::new(&layout(), MAX_BUFFERS + 4);
        events.into_iter().for_each(|event| model.apply(event));
    }
}
