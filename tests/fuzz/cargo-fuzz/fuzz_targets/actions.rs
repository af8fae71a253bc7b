#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| endless_gym_fuzz::run(endless_gym_fuzz::actions::target, data));
