//! The program `endless`.

use std::process::ExitCode;

/// `endless check` checks that a step does not allocate.
#[global_allocator]
static ALLOCATOR: endless_gym::conformance::CountingAllocator = endless_gym::conformance::CountingAllocator;

fn main() -> ExitCode {
    endless_gym::program(endless_gym::environments())
}
