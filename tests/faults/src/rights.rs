//! Finds out what the machine permits.

use std::process::{Command, Stdio};

use crate::actors;
use crate::plan::Right;

/// The permissions that the machine grants.
#[derive(Clone, Copy, Debug)]
pub struct Rights {
    mount_namespaces: bool,
    other_users: bool,
}

impl Rights {
    /// Tries each permission.
    pub fn probe() -> Self {
        let succeeds = |mut command: Command| {
            let quiet = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            quiet.status().is_ok_and(|status| status.success())
        };
        let mut version = Command::new(actors::own_program().unwrap_or_default());
        version.arg("--version");
        Rights {
            mount_namespaces: succeeds(actors::with_own_memory(&Command::new("true"), 1)),
            other_users: succeeds(actors::as_nobody(&version)),
        }
    }

    /// Whether a permission is granted; `None` needs none.
    pub fn permit(self, right: Option<Right>) -> bool {
        match right {
            None => true,
            Some(Right::MountNamespaces) => self.mount_namespaces,
            Some(Right::OtherUsers) => self.other_users,
        }
    }
}
