//! `endless record --film`: compares the decoded files with the frames of a pool in this process.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::text;
use endless_gym::batch::{Frames, PixelFormat};
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, Experts, PoolConfig, ResetRequest};

const SIDE: usize = 84;
const GAP: usize = 2;

type Picture = Vec<[u8; 3]>;

/// The observation and the ground-truth view, 84x84 in rows, of each step of an expert's episode.
fn frames(id: &str, seed: u64, max_steps: usize) -> Vec<(Picture, Picture)> {
    let format = PixelFormat { row_major: true, ..PixelFormat::default() };
    let config =
        PoolConfig::new(id, 1).features(true).frames(Some(Frames { format, stack: 1 })).autoreset(Autoreset::Disabled);
    let mut player = Player::new(&config);
    player.reset(ResetRequest::Seed(seed));
    let spec = player.pool.spec();
    let mut experts = Experts::new(memory_gym(), spec.id, 1, config.autoreset).unwrap();
    let mut action = vec![0; spec.action_space.width()];
    let mut frames = Vec::new();
    loop {
        let view = player.pool.ground_truth_view(0).unwrap().pixels;
        let view = (0..SIDE * SIDE).map(|place| {
            let at = (place / SIDE * 4 * SIDE * 4 + place % SIDE * 4) * 3;
            [view[at], view[at + 1], view[at + 2]]
        });
        let batch = player.batch();
        frames.push((batch.observation().as_chunks::<3>().0.to_vec(), view.collect()));
        if batch.terminated()[0] == 1 || frames.len() > max_steps {
            return frames;
        }
        experts.act(&batch, &mut action).unwrap();
        player.step(&action);
    }
}

/// Both views side by side, magnified.
fn both((agent, view): &(Picture, Picture), scale: usize) -> Picture {
    let width = 2 * SIDE + GAP;
    let pixel = |row: usize, column: usize| match column {
        column if column < SIDE => agent[row * SIDE + column],
        column if column < SIDE + GAP => [24; 3],
        column => view[row * SIDE + column - SIDE - GAP],
    };
    (0..width * SIDE * scale * scale)
        .map(|place| pixel(place / (width * scale) / scale, place % (width * scale) / scale))
        .collect()
}

fn record(place: &Place, arguments: &[&str], file: &Path) -> String {
    let output = place.run(&[&["record"], arguments, &["--film", file.to_str().unwrap()]].concat());
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout).to_owned()
}

/// Pictures and delays in seconds of an animated WebP.
fn decode_webp(file: &Path) -> Vec<(Picture, f64)> {
    let mut decoder = image_webp::WebPDecoder::new(BufReader::new(File::open(file).unwrap())).unwrap();
    assert!(decoder.is_animated() && !decoder.has_alpha() && !decoder.is_lossy());
    assert_eq!(decoder.loop_count(), image_webp::LoopCount::Forever);
    let mut buffer = vec![0; decoder.output_buffer_size().unwrap()];
    let pictures = (0..decoder.num_frames()).map(|_| {
        let delay = f64::from(decoder.read_frame(&mut buffer).unwrap()) / 1000.0;
        (buffer.as_chunks::<3>().0.to_vec(), delay)
    });
    pictures.collect()
}

#[test]
fn webp_films_have_every_pixel_of_every_episode() {
    let place = Place::new();
    let file = place.root().join("film.webp");
    for (id, scale, steps, options) in [
        ("MysteryPath-Grid-v0", 2, 1000, &[][..]),
        ("SearingSpotlights-v0", 1, 20, &[][..]),
        ("MortarMayhem-v0", 3, 15, &["--fps", "7"]),
    ] {
        let (scale_text, steps_text) = (scale.to_string(), steps.to_string());
        let arguments = [id, "--seed", "3", "--episodes", "2", "--scale", &scale_text, "--max-steps", &steps_text];
        let said = record(&place, &[&arguments, options].concat(), &file);
        let episodes = [frames(id, 3, steps), frames(id, 4, steps)];
        for (seed, episode) in (3..).zip(&episodes) {
            let steps = episode.len() - 1;
            assert!(
                said.contains(&format!("seed {seed}: ")) && said.contains(&format!(" in {steps} steps\n")),
                "{said}"
            );
        }
        let decoded = decode_webp(&file);
        assert_eq!(decoded.len(), episodes[0].len() + episodes[1].len(), "{id}");
        for (number, ((picture, _), frame)) in decoded.iter().zip(episodes.iter().flatten()).enumerate() {
            assert!(*picture == both(frame, scale), "{id}, picture {number}");
        }
        // Delays are in milliseconds, but the whole film has the right duration.
        let fps =
            options.get(1).map_or(f64::from(memory_gym().spec(id).unwrap().render_fps), |fps| fps.parse().unwrap());
        let duration: f64 = decoded.iter().map(|(_, delay)| delay).sum();
        let expected = decoded.len() as f64 / fps + 2.0;
        assert!((duration - expected).abs() < 0.0006, "{id}: {duration} s, expected {expected} s");
        // Decoders that read chunk by chunk need the right length and padding.
        let bytes = std::fs::read(&file).unwrap();
        assert_eq!(u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize + 8, bytes.len());
    }
    assert_eq!(std::fs::read_dir(place.root()).unwrap().count(), 1, "only the film is left");
}

#[test]
fn films_show_one_view_or_both() {
    let place = Place::new();
    let (id, file) = ("MortarMayhem-Grid-v0", place.root().join("film.WebP"));
    let frames = frames(id, 0, 5);
    for view in ["agent", "ground-truth"] {
        record(&place, &[id, "--view", view, "--scale", "1", "--max-steps", "5", "--fps", "10"], &file);
        let decoded = decode_webp(&file);
        assert_eq!(decoded.len(), 6);
        for ((picture, _), (agent, ground_truth)) in decoded.iter().zip(&frames) {
            assert!(picture == if view == "agent" { agent } else { ground_truth }, "{view}");
        }
        assert_eq!(decoded[0].1, 0.1);
    }
    // All these steps show the agent the command, but not where it leads.
    assert!(frames.iter().any(|(agent, ground_truth)| agent != ground_truth));
}

/// Checks ffmpeg's input with a stand-in that writes its input to the file in its last argument.
#[test]
fn mp4_films_are_encoded_by_ffmpeg() {
    let place = Place::new();
    let (id, file, ffmpeg) = ("MysteryPath-Grid-v0", place.root().join("film.mp4"), place.root().join("ffmpeg"));
    let run = || {
        let arguments = ["record", id, "--max-steps", "4", "--scale", "2", "--film", file.to_str().unwrap()];
        place.endless(&arguments).env("IMAGEIO_FFMPEG_EXE", &ffmpeg).output().unwrap()
    };
    let missing = run();
    assert_eq!(missing.status.code(), Some(1));
    assert!(
        text(&missing.stderr).contains("an .mp4 needs ffmpeg, and there is no program"),
        "{}",
        text(&missing.stderr)
    );

    place.script("ffmpeg", "echo no such codec >&2; exit 3");
    let failed = run();
    assert_eq!(failed.status.code(), Some(1));
    let message = text(&failed.stderr);
    assert!(message.contains("ffmpeg failed to write") && message.contains("no such codec"), "{message}");
    assert_eq!(std::fs::read_dir(place.root()).unwrap().count(), 1, "nothing half-written is left");

    place.script("ffmpeg", "echo \"$@\" > \"$0.arguments\"; while [ $# -gt 1 ]; do shift; done; cat > \"$1\"");
    let written = run();
    assert!(written.status.success(), "{}", text(&written.stderr));
    let fps = memory_gym().spec(id).unwrap().render_fps as usize;
    let mut expected: Vec<Picture> = frames(id, 0, 4).iter().map(|frame| both(frame, 2)).collect();
    let last = expected[4].clone();
    expected.extend(std::iter::repeat_n(last, fps));
    assert!(std::fs::read(&file).unwrap() == expected.concat().into_flattened());
    let arguments = std::fs::read_to_string(place.root().join("ffmpeg.arguments")).unwrap();
    assert!(arguments.contains(&format!("-pix_fmt rgb24 -s 340x168 -r {fps} -i -")), "{arguments}");
}

#[test]
fn random_play_depends_only_on_its_seeds() {
    let place = Place::new();
    let file = place.root().join("film.webp");
    let film = |seed: &str, policy: &str| {
        let arguments =
            ["MysteryPath-v0", "--max-steps", "20", "--scale", "1", "--policy", policy, "--action-seed", seed];
        record(&place, &arguments, &file);
        std::fs::read(&file).unwrap()
    };
    let first = film("1", "random");
    assert!(first == film("1", "random"));
    assert!(first != film("2", "random"));
    assert!(film("1", "expert") == film("2", "expert"));
}
