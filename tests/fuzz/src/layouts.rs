//! Layouts of batches and requests, as JSON text.

use arbitrary::{Result, Unstructured};
use endless_gym_core::batch::{ActionLayout, Batch, Layout, zeroed};

/// Larger batches are not allocated.
const MAX_BLOCKS: usize = 1 << 14;

pub(crate) fn target(input: &mut Unstructured<'_>) -> Result<()> {
    let data = input.bytes(input.len())?;
    if let Ok(layout) = serde_json::from_slice::<Layout>(data)
        && layout.blocks() <= MAX_BLOCKS
    {
        let mut blocks = zeroed(layout.blocks());
        for section in layout.sections() {
            layout.write::<u8>(&mut blocks, section.name()).fill(1);
            let short = &blocks[..blocks.len() / 2];
            assert!(layout.read::<u64>(short, section.name()).len() <= section.bytes());
        }
        layout.forget_frames(&mut blocks);
        let batch = Batch::new(&layout, &blocks);
        assert_eq!(batch.reward().len(), layout.num_envs());
        assert_eq!(batch.terminated().len(), layout.num_envs());
        assert_eq!(batch.episode_length().len(), layout.num_envs());
        let text = serde_json::to_vec(&layout).expect("a layout is JSON");
        assert_eq!(serde_json::from_slice::<Layout>(&text).ok(), Some(layout));
    }
    if let Ok(layout) = serde_json::from_slice::<ActionLayout>(data)
        && layout.blocks() <= MAX_BLOCKS
    {
        let mut blocks = zeroed(layout.blocks());
        for section in layout.sections() {
            layout.write::<i32>(&mut blocks, section.name()).fill(1);
            assert!(layout.read::<u8>(&[], section.name()).is_empty());
        }
    }
    Ok(())
}
