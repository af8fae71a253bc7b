//! Vector instructions of the CPU that runs the program.

/// Defines a function that is also compiled for vectors of 256 and 512 bits with fused multiply-add, and uses the longest that the CPU
/// has. In the body, `LANES` is the number of f32 in a vector: 16 or 8, and 8 without these instructions.
///
/// The results are the same on every CPU: `f32::mul_add` rounds once, in hardware or in software, and no sum is reordered.
/// Functions that the body calls must be `#[inline(always)]`, since only what is inlined is compiled for these instructions.
macro_rules! vectorised {
    ($(#[$attribute:meta])* $visible:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) $body:block) => {
        $(#[$attribute])*
        $visible fn $name($($argument: $type),*) {
            #[inline(always)]
            fn kernel<const LANES: usize>($($argument: $type),*) $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f")]
                fn with_avx512($($argument: $type),*) {
                    kernel::<16>($($argument),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn with_avx2($($argument: $type),*) {
                    kernel::<8>($($argument),*)
                }
                if is_x86_feature_detected!("avx512f") {
                    // SAFETY: the CPU has the feature, which includes AVX2 and FMA.
                    #[allow(unsafe_code)]
                    return unsafe { with_avx512($($argument),*) };
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the CPU has both features.
                    #[allow(unsafe_code)]
                    return unsafe { with_avx2($($argument),*) };
                }
            }
            kernel::<8>($($argument),*)
        }
    };
}

pub(crate) use vectorised;
