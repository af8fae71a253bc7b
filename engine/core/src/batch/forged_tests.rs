//! Forged layouts are rejected, or can be used like any other.

use proptest::prelude::*;
use proptest::test_runner::contextualize_config;
use serde_json::{Value as Json, json};

use super::*;
use crate::toy::toys;

fn layout(num_envs: usize) -> Layout {
    let contents = Contents { frames: Some(Frames::default()), features: true, state: false, final_observation: true };
    batch_layout(toys().spec("Toy-v0").unwrap(), num_envs, contents).unwrap()
}

/// The error from deserialising a layout with one part replaced.
fn refused(pointer: &str, value: Json) -> String {
    let mut json = serde_json::to_value(layout(4)).unwrap();
    *json.pointer_mut(pointer).expect(pointer) = value;
    serde_json::from_value::<Layout>(json).unwrap_err().to_string()
}

#[test]
fn forged_layouts_are_refused() {
    let mut valid = serde_json::to_value(layout(4)).unwrap();
    let blocks = layout(4).blocks();
    // observation, features, ground_truth, reward, terminated, truncated, ...
    assert_eq!(valid["sections"][3]["name"], "reward");
    for (pointer, value, message) in [
        ("/num_envs", json!(0), "num_envs must be 1 to 1048576, got 0".to_owned()),
        ("/num_envs", json!(1_u64 << 40), "num_envs must be 1 to 1048576, got 1099511627776".to_owned()),
        ("/sections/3/name", json!("rewards"), "unknown section `rewards`".to_owned()),
        ("/sections/3/name", json!("action"), "unknown section `action`".to_owned()),
        ("/sections/4/name", json!("truncated"), "section `truncated` is given twice".to_owned()),
        ("/sections/3/dtype", json!("float32"), "section `reward` must have dtype float64, got float32".to_owned()),
        ("/sections/3/shape", json!([1]), "the row shape of section `reward` must be (), got [1]".to_owned()),
        (
            "/sections/0/shape",
            json!([1, 1, 1, 1, 1, 1, 1, 1, 1]),
            "the row shape of section `observation` must be a frame's shape of 2 to 4 dimensions, got \
             [1, 1, 1, 1, 1, 1, 1, 1, 1]"
                .to_owned(),
        ),
        (
            "/sections/3/offset",
            json!(90_001),
            "the offset of section `reward` must be a multiple of 64, got 90001".to_owned(),
        ),
        (
            "/sections/3/offset",
            json!(64),
            "sections must be in the order of their offsets; section `reward` at byte 64 follows a later one"
                .to_owned(),
        ),
        (
            "/blocks",
            json!(0),
            format!("section `observation` ends at byte {}, beyond the declared 0 blocks of 64 bytes", 4 * 21168),
        ),
        (
            "/blocks",
            json!(blocks + 1),
            format!("blocks must be {blocks}, the size of all sections, got {}", blocks + 1),
        ),
        (
            "/blocks",
            json!(blocks - 1),
            format!("blocks must be {blocks}, the size of all sections, got {}", blocks - 1),
        ),
    ] {
        let found = refused(pointer, value.clone());
        assert_eq!(found, message, "{pointer} {value}");
    }
    let last = valid["sections"].as_array().unwrap().len() - 1;
    let overlapping = &valid["sections"][1]["offset"].as_u64().unwrap() - 64;
    assert!(refused("/sections/1/offset", json!(overlapping)).contains("overlaps the one before it"));
    let beyond = (layout(4).blocks() * BLOCK_BYTES) as u64;
    assert!(refused(&format!("/sections/{last}/offset"), json!(beyond)).contains("beyond the declared"));
    for shape in
        [json!([u64::MAX, 2]), json!([u64::MAX, 0]), json!([1_u64 << 62, 1_u64 << 62]), json!([1_u64 << 61, 1])]
    {
        assert_eq!(refused("/sections/0/shape", shape), "section `observation` is too large for the address space");
    }
    let edge = json!(u64::MAX - 63);
    assert!(refused(&format!("/sections/{last}/offset"), edge).contains("too large for the address space"));
    assert!(refused("/num_envs", json!(5)).contains("overlaps the one before it"));
    valid["sections"].as_array_mut().unwrap().remove(3);
    let error = serde_json::from_value::<Layout>(valid).unwrap_err();
    assert_eq!(error.to_string(), "section `reward` is missing");
}

#[test]
fn messages_that_are_too_short_for_their_bytes_are_refused() {
    let spec = toys().specs().next().unwrap();
    let mut json = serde_json::to_value(action_layout(&spec.action_space, 4).unwrap()).unwrap();
    json["sections"][3]["shape"] = json!([1000]);
    let error = serde_json::from_value::<ActionLayout>(json).unwrap_err();
    assert_eq!(error.to_string(), "section `options` must have at least 16384 bytes, got 4000");
}

/// A number that a forger might try.
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

/// Replaces, removes, duplicates and swaps parts.
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

/// Reads and writes a batch, also in part, of that layout, and one that is too short.
fn use_all(layout: &Layout) -> Result<(), TestCaseError> {
    prop_assert!(BatchMut::new(layout, &mut zeroed(layout.blocks().min(1 << 16) - 1)).is_none());
    if layout.blocks() > 1 << 16 {
        return Ok(());
    }
    let mut blocks = zeroed(layout.blocks());
    let all = BatchMut::new(layout, &mut blocks).unwrap();
    // SAFETY: it is the only part.
    let mut right = unsafe { all.part(layout.num_envs() - 1..layout.num_envs()) };
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
        prop_assert!(section.name().row().admits(section.shape()) && section.shape().len() < MAX_DIMENSIONS);
        let short = &blocks[..layout.blocks() / 2];
        prop_assert!(layout.read::<u8>(short, section.name()).len() <= section.bytes());
        prop_assert!(layout.write::<f64>(&mut zeroed(1), section.name()).len() <= 8);
    }
    Ok(())
}

proptest! {
    #![proptest_config(contextualize_config(ProptestConfig::with_cases(2_000)))]

    /// Any layout that deserialises can be read and written.
    #[test]
    fn forged_layouts_are_refused_or_usable(
        id in 0..3_usize,
        num_envs in 1..5_usize,
        options in 0..16_u8,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), values()), 1..3),
    ) {
        let spec = toys().specs().nth(id).unwrap();
        let contents = Contents {
            frames: (options & 1 != 0).then(Frames::default),
            features: options & 2 != 0,
            state: options & 4 != 0,
            final_observation: options & 8 != 0,
        };
        let layout = batch_layout(spec, num_envs, contents).unwrap();
        use_all(&layout)?;
        if let Ok(layout) = serde_json::from_value::<Layout>(forge(serde_json::to_value(&layout).unwrap(), &changes)) {
            use_all(&layout)?;
        }
        let layout = action_layout(&spec.action_space, num_envs).unwrap();
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
