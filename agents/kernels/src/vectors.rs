//! Vector instructions of the CPU that runs the program.

/// Defines a function that is also compiled for 256-bit vectors with fused multiply-add, and uses them where the CPU has them.
///
/// The results are the same on every CPU: `f32::mul_add` rounds once, in hardware or in software, and no sum is reordered.
/// Functions that the body calls must be `#[inline(always)]`, since only what is inlined is compiled for these instructions.
macro_rules! vectorised {
    ($(#[$attribute:meta])* fn $name:ident($($argument:ident: $type:ty),* $(,)?) $body:block) => {
        $(#[$attribute])*
        fn $name($($argument: $type),*) {
            #[inline(always)]
            fn kernel($($argument: $type),*) $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn with_avx2($($argument: $type),*) {
                    kernel($($argument),*)
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the CPU has both features.
                    #[allow(unsafe_code)]
                    return unsafe { with_avx2($($argument),*) };
                }
            }
            kernel($($argument),*)
        }
    };
}

pub(crate) use vectorised;
