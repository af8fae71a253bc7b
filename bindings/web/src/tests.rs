//! Tests the interface as JavaScript uses it.

use super::*;
use endless_gym_memory_gym::SCREEN;
use endless_gym_memory_gym::memory_gym;
use serde_json::{Value as Json, json};

fn put(bytes: &[u8]) {
    input(bytes.len());
    INPUT.with_borrow_mut(|input| input.copy_from_slice(bytes));
}

fn answer() -> Vec<u8> {
    assert_eq!(output_length(), OUTPUT.with_borrow(Vec::len));
    OUTPUT.with_borrow(Clone::clone)
}

fn request(request: &Json) -> Result<Json, String> {
    put(request.to_string().as_bytes());
    let kind = call();
    let text = String::from_utf8(answer()).unwrap();
    if kind == Kind::Error as u32 { Err(text) } else { Ok(serde_json::from_str(&text).unwrap()) }
}

fn start(id: &str, seed: &str) -> Result<Json, String> {
    request(&json!({"start": {"id": id, "options": {}, "seed": seed}}))
}

#[test]
fn every_environment_is_played_saved_and_opened_again() {
    environments();
    for spec in memory_gym().specs() {
        let mut state = start(spec.id, "7").unwrap();
        assert_eq!(state["seed"], "7");
        while state["done"] == false && state["length"].as_u64() < Some(300) {
            state = request(&json!("step_of_expert")).unwrap();
        }
        put(br#""save""#);
        assert_eq!(call(), Kind::Bytes as u32);
        let file = answer();
        put(&file);
        assert_eq!(open(), Kind::Json as u32, "{}", String::from_utf8_lossy(&answer()));
        let opened: Json = serde_json::from_slice(&answer()).unwrap();
        assert_eq!(opened["differences"], 0, "{}: {}", spec.id, opened["first"]);
        assert_eq!(opened["steps"], state["length"]);
        // Replaying it step by step, as the page does, gives the same numbers.
        let mut replayed = opened["state"].clone();
        while replayed["recording"]["over"] == false {
            replayed = request(&json!("step_of_trace")).unwrap();
        }
        for same in ["return", "length", "done", "progress", "seed", "action", "info"] {
            assert_eq!(replayed[same], state[same], "{}: {same}", spec.id);
        }
        assert_eq!(request(&json!("step_of_trace")).unwrap_err(), "the recording has no more steps");
    }
}

#[test]
fn errors_are_those_of_the_engine() {
    environments();
    for (wrong, message) in [
        (json!({"start": {"id": "Pong-v0", "options": {}, "seed": "1"}}), "no environment `Pong-v0`; there are Mort"),
        (
            json!({"check": {"id": "MysteryPath-v0", "options": {"agent_scale": "large"}}}),
            r#"reset parameter `agent_scale` must be a number, 0 to 4, got "large""#,
        ),
        (
            json!({"check": {"id": "MysteryPath-v0", "options": {"cardinal_origin_choice": "[0, 9]"}}}),
            "reset parameter `cardinal_origin_choice` must be a list of 1 to 4096 integers, 0 to 3, got [0,9]",
        ),
        (
            json!({"start": {"id": "MysteryPath-v0", "options": {}, "seed": "-1"}}),
            "seed must be an integer, 0 to 18446744073709551615, got `-1`",
        ),
        (json!("dance"), "the request cannot be read: unknown variant `dance`"),
        (json!("step_of_expert"), "there is no episode"),
        (json!({"wall": {"groups": [], "columns": 3, "expert": false, "seed": "1"}}), "a wall must have at least one"),
    ] {
        let found = request(&wrong).unwrap_err();
        assert!(found.starts_with(message), "{found}");
    }
    assert_eq!(step_wall(1), Kind::Error as u32);
    put(b"no trace");
    assert_eq!(open(), Kind::Error as u32);
    assert!(answer().starts_with(b"the file must be a trace (gzipped JSON)"));
    assert!(observation().is_null() && view().is_null() && draw_wall().is_null());
}

#[test]
fn the_expert_plays_from_the_first_step_or_not_at_all() {
    environments();
    start("MortarMayhem-v0", "18446744073709551615").unwrap();
    request(&json!({"step": {"action": [0, 0]}})).unwrap();
    let late = request(&json!("step_of_expert")).unwrap_err();
    assert!(late.starts_with("the expert must play an episode from its first step"), "{late}");
    assert!(request(&json!({"step": {"action": [0, 3]}})).unwrap_err().contains("must be in MultiDiscrete([3, 3])"));
    // The episode continues after an error.
    assert_eq!(request(&json!({"step": {"action": [0, 0]}})).unwrap()["length"], 2);
}

#[test]
fn the_table_has_what_a_form_needs() {
    environments();
    let table = request(&json!("specs")).unwrap();
    assert_eq!(table.as_array().unwrap().len(), memory_gym().specs().count());
    let parameter = &table[0]["parameters"][4];
    assert_eq!(
        (&parameter["name"], &parameter["type"], &parameter["default_text"], &parameter["allowed"]),
        (&json!("command_count"), &json!("int_list"), &json!("[10]"), &json!("list of 1 to 4096 integers, 1 to 1000"))
    );
}

#[test]
fn clues_are_what_the_episode_has_shown() {
    environments();
    for spec in memory_gym().specs() {
        let mut state = start(spec.id, "5").unwrap();
        let (mut coins, mut steps) = (0, 0);
        while state["done"] == false && steps < 600 {
            state = request(&json!("step_of_expert")).unwrap();
            coins = coins.max(state["clues"]["coins"].as_array().map_or(0, Vec::len));
            steps += 1;
        }
        let progress = |name: &str| {
            state["progress"]
                .as_array()
                .unwrap()
                .iter()
                .find(|row| row["name"] == name)
                .map_or(0, |row| row["value"].as_f64().unwrap() as usize)
        };
        let (clues, length) = (&state["clues"], |name: &str| state["clues"][name].as_array().map_or(0, Vec::len));
        if spec.id.contains("MortarMayhem") {
            let carried = clues["carried_out"].as_array().unwrap();
            let shown = clues["commands"].as_array().unwrap();
            // Those of MortarMayhemB are not shown.
            assert!(
                shown.is_empty() == spec.id.contains("MayhemB") && (shown.is_empty() || shown.starts_with(carried)),
                "{}: {clues}",
                spec.id
            );
            assert!(!spec.id.starts_with("Endless") || shown.len() > 3, "{clues}");
            assert!(spec.id.starts_with("Endless") || carried.len() == progress("commands"), "{clues}");
        } else if spec.id.contains("MysteryPath") {
            assert_eq!(
                (length("walked"), length("falls")),
                (progress("tiles") + 1, progress("falls")),
                "{}: {clues}",
                spec.id
            );
        } else {
            assert!(coins == 1 && length("coins") <= 1 && progress("coins") > 0, "{}: {clues}", spec.id);
        }
    }
}

#[test]
fn a_wall_plays_all_environments_at_once() {
    environments();
    for expert in [false, true] {
        let groups: Vec<Json> =
            memory_gym().specs().map(|spec| json!({"id": spec.id, "num_envs": 3, "options": {}})).collect();
        let wall = json!({"wall": {"groups": groups, "columns": 7, "expert": expert, "seed": "3"}});
        let state = request(&wall).unwrap();
        // 30 environments in rows of 7.
        assert_eq!((&state["width"], &state["height"]), (&json!(7 * 88 - 4), &json!(5 * 88 - 4)));
        assert_eq!(step_wall(150), Kind::Json as u32);
        let state: Json = serde_json::from_slice(&answer()).unwrap();
        let episodes = |group: &Json| group["episodes"].as_u64().unwrap();
        assert!(state["groups"].as_array().unwrap().iter().map(episodes).sum::<u64>() > 0);
        let picture = APP.with_borrow_mut(|app| app.wall.as_mut().unwrap().draw().to_vec());
        let opaque = picture.chunks_exact(4).filter(|pixel| pixel[3] == 255).count();
        assert_eq!(opaque, 30 * SCREEN * SCREEN);
    }
}

#[test]
fn the_episode_of_a_tile_is_played_alone() {
    environments();
    for spec in memory_gym().specs() {
        let groups = json!([
            {"id": "MysteryPath-v0", "num_envs": 2, "options": {}},
            {"id": spec.id, "num_envs": 3, "options": {"agent_scale": "0.3"}}
        ]);
        request(&json!({"wall": {"groups": groups, "columns": 2, "expert": false, "seed": "3"}})).unwrap();
        let tile = request(&json!({"tile": {"place": 4}})).unwrap();
        assert_eq!((&tile["id"], &tile["options"]), (&json!(spec.id), &json!({"agent_scale": "0.3"})));
        request(&json!({"start": tile})).unwrap();
        // The frame of the first step shows the same episode: the wall's is at row 2, column 0.
        let same = APP.with_borrow_mut(|app| {
            let wall = app.wall.as_mut().unwrap().draw();
            let game = app.game.as_ref().unwrap().observation();
            let row = |y: usize| &wall[(2 * (SCREEN + 4) + y) * (2 * SCREEN + 4) * 4..][..SCREEN * 4];
            (0..SCREEN).all(|y| *row(y) == game[y * SCREEN * 4..][..SCREEN * 4])
        });
        assert!(same, "{}", spec.id);
        assert!(request(&json!({"tile": {"place": 5}})).unwrap_err().starts_with("the wall has no environment"));
    }
}

#[path = "../tests/own/lib.rs"]
mod own;

#[test]
fn environments_of_ones_own_are_played_saved_and_opened_again() {
    assert_eq!(populate(own::registry()), Kind::Json as u32);
    // The bits of 0.5, as the page sends them.
    for (id, action) in
        [("Small-v0", json!([3])), ("Numbers-v0", json!([2, 4])), ("Slider-v0", json!([0x3f00_0000, 0]))]
    {
        let mut state = start(id, "7").unwrap();
        while state["done"] == false {
            state = request(&json!({"step": {"action": action}})).unwrap();
        }
        assert_eq!((&state["action"], &state["length"]), (&action, &json!(own::STEPS)), "a truncated episode is over");
        let frame = own::registry().unwrap().spec(id).unwrap().frame;
        APP.with_borrow(|app| {
            let game = app.game.as_ref().unwrap();
            let bytes = frame.map_or(0, |frame| frame.width * frame.height * 4);
            assert_eq!((game.observation().len(), game.view().len()), (bytes, bytes));
            if frame.is_some() {
                assert_eq!(game.observation(), game.view());
                assert!(game.observation().contains(&200), "{id}");
            }
        });
        let features = if frame.is_some() { Json::Null } else { json!([2.0, 4.0]) };
        assert_eq!(state["features"], features, "{id}");
        put(br#""save""#);
        assert_eq!(call(), Kind::Bytes as u32);
        put(&answer());
        assert_eq!(open(), Kind::Json as u32, "{}", String::from_utf8_lossy(&answer()));
        let opened: Json = serde_json::from_slice(&answer()).unwrap();
        assert_eq!((&opened["differences"], &opened["steps"]), (&json!(0), &state["length"]), "{id}");
        assert_eq!(request(&json!("step_of_expert")).unwrap_err(), format!("`{id}` has no scripted expert"));
    }
}

#[test]
fn a_wall_has_frames_of_several_sizes() {
    populate(own::registry());
    let wall = |ids: &[&str]| {
        let groups: Vec<Json> = ids.iter().map(|id| json!({"id": id, "num_envs": 2, "options": {}})).collect();
        request(&json!({"wall": {"groups": groups, "columns": 2, "expert": true, "seed": "3"}}))
    };
    let state = wall(&["Small-v0", "Slider-v0"]).unwrap();
    // Two rows and columns of cells for frames with 20 columns and 12 rows.
    assert_eq!((&state["width"], &state["height"]), (&json!(2 * 24 - 4), &json!(2 * 16 - 4)));
    assert_eq!(step_wall(2 * own::STEPS), Kind::Json as u32);
    let state: Json = serde_json::from_slice(&answer()).unwrap();
    assert!(state["groups"].as_array().unwrap().iter().all(|group| group["episodes"].as_u64() >= Some(2)), "{state}");
    let picture = APP.with_borrow_mut(|app| app.wall.as_mut().unwrap().draw().to_vec());
    let opaque = picture.chunks_exact(4).filter(|pixel| pixel[3] == 255).count();
    assert_eq!(opaque, 2 * 12 * 12 + 2 * 20 * 8);
    assert_eq!(wall(&["Numbers-v0"]).unwrap_err(), "`Numbers-v0` has no frames, which a wall shows; play it alone");
}

#[test]
fn a_page_needs_environments() {
    assert_eq!(populate(Ok(Registry::new())), Kind::Error as u32);
    assert_eq!(answer(), b"the page needs at least one environment");
    let twice = own::registry().and_then(Registry::with::<own::Small>);
    assert_eq!(populate(twice), Kind::Error as u32);
    assert_eq!(answer(), b"the registry already has an environment `Small-v0`");
}
