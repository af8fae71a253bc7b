//! What several modules of tests share.

pub mod chromium;
pub mod foreign;
pub mod page;
pub mod program;
pub mod recorded;
pub mod service;

/// Marks the process that [`alone`] started.
const ALONE: &str = "ENDLESS_TEST_ALONE";

/// Runs the test `name` of this program in a process of its own, and fails as it does. Returns true there.
pub fn alone(name: &str) -> bool {
    if std::env::var_os(ALONE).is_some() {
        return true;
    }
    let mut test = std::process::Command::new(std::env::current_exe().unwrap());
    let output = test.args([name, "--exact", "--include-ignored", "--nocapture"]).env(ALONE, "1").output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && text.contains("1 passed"), "{}: {text}", output.status);
    false
}
