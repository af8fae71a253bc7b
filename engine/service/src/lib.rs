//! The service: one engine, its trainer and observers, in shared memory.
//!
//! An **engine** serves groups of environments under a name; a **trainer** acts in them; **observers** watch. They are
//! processes of one user on one host, and meet in a [`Namespace`]. The middleware is iceoryx2: a message is written once,
//! where its reader reads it.
//!
//! # Services
//!
//! | service | kind | from → to | content |
//! | --- | --- | --- | --- |
//! | `endless-gym/NAME` | blackboard | engine → all | the [`Specification`], for whoever comes whenever |
//! | `endless-gym/NAME/EPOCH/act/GROUP` | publish/subscribe | trainer → engine | actions or a reset |
//! | `endless-gym/NAME/EPOCH/obs/GROUP` | publish/subscribe | engine → trainer, observers | a batch or a rejection |
//! | `endless-gym/NAME/EPOCH/to_engine` | event | trainer → engine | number of the group that has a message |
//! | `endless-gym/NAME/EPOCH/to_trainer` | event | engine → trainer | number of the group that has a batch |
//!
//! The epoch is drawn when an engine starts, so that one that starts after a crash shares nothing with what the dead one left.
//!
//! # Messages
//!
//! The payload of `act` and `obs` is `[Block]`, laid out as the specification says. All else is in the user header:
//!
//! | header | fields |
//! | --- | --- |
//! | action | layout version, kind (step, reset all, reset from a seed, reset each, snapshot, restore), epoch, trainer, request, seed, environment, bytes of options or of a snapshot |
//! | observation | layout version, group, epoch, step, trainer and request that it answers, status, text of a rejection, bytes of a snapshot |
//!
//! # Protocol
//!
//! | situation | what happens |
//! | --- | --- |
//! | a message arrives | it is answered by exactly one batch, snapshot or rejection of the same group; a rejection moves no environment |
//! | a trainer asks for a snapshot, or to restore one | the answer holds its bytes, or none, in place of a batch; observers pass it over, and may have missed the batch before it |
//! | a group owes a batch | its trainer may not send to it again; other groups are not concerned |
//! | a trainer is new | it resets all environments of a group before it steps them |
//! | a second trainer | is refused: `act` takes one publisher |
//! | a trainer dies | the engine removes its leftovers when it has nothing to do; the next trainer does so too when it connects |
//! | an engine dies or ends | the trainer notices when it hears nothing for a while, and may reconnect to a new one |
//! | an observer is slow | it misses batches; its one place in the buffer is overwritten |
//! | a message of another epoch | is dropped |

mod config;
mod engine;
mod error;
mod here;
mod message;
mod node;
mod observer;
mod ports;
mod preflight;
mod received;
mod specification;
mod sweep;
mod trainer;
mod wait;

pub use config::{Namespace, ROOT_VARIABLE};
pub use engine::{Engine, EngineConfig, MAX_GROUPS, Summary};
pub use error::{Rejection, ServiceError};
pub use observer::Observer;
pub use received::Received;
pub use specification::{Specification, engines};
pub use trainer::{ConnectConfig, Trainer};
