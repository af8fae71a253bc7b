//! The tests across crates, in one program.

mod allocation;
mod browser;
mod checkpoints;
mod conformance;
mod drawing;
mod examples;
mod experts;
mod faulty_environments;
mod films;
mod formats;
mod full_disks;
mod independent_episodes;
mod live;
mod meanings;
mod next_options;
mod own_environment;
mod own_frames;
mod pool;
mod popgym;
mod program;
mod public_api;
mod recordings;
mod service;
mod service_episodes;
mod service_faults;
mod service_forged;
mod service_groups;
mod service_observers;
mod service_pause;
mod service_pictures;
mod service_promise;
mod service_snapshots;
mod serving;
mod snapshots;
mod support;
mod terminal;
mod traces;
mod untrusted_files;
mod view;
mod web_attacks;

/// The entry point of other tests' child processes; an environment variable names their role.
#[test]
#[ignore = "does nothing on its own"]
fn role() {
    support::service::play_role();
}
