//! Finds out what the machine permits.

use std::process::{Command, Stdio};

use crate::actors;
use crate::plan::{Fault, Plan};

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

    /// Whether they suffice for a fault.
    pub fn permit(self, fault: Fault) -> bool {
        match fault {
            Fault::FillMemory { .. } | Fault::OtherContainer => self.mount_namespaces,
            Fault::OtherUser => self.other_users,
            _ => true,
        }
    }

    /// Whether they suffice to begin a round.
    pub fn permit_round(self, plan: &Plan) -> bool {
        plan.own_memory.is_none() || self.mount_namespaces
    }
}
