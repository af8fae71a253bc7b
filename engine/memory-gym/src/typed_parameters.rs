//! The reset parameters of a family as typed values.

/// The type of a reset parameter that this method of `ResetParameters` returns.
macro_rules! type_of {
    (int) => { i64 };
    (float) => { f64 };
    (bool) => { bool };
    (int_list) => { Vec<i64> };
}
pub(crate) use type_of;

/// Declares `Parameters`: first the fields that are reset parameters, each with the default for ids without it; then those that are made
/// from reset parameters.
macro_rules! typed_parameters {
    (
        $variant:ident, $given:ident;
        $($name:ident: $read:ident($($default:expr)?),)*
        ;
        $($(#[$doc:meta])* $made:ident: $type:ty = $value:expr,)*
    ) => {
        /// One set of reset parameters. The registry describes them.
        #[derive(Clone, Debug, PartialEq)]
        pub struct Parameters {
            $(#[doc = concat!("The reset parameter `", stringify!($name), "`.")] pub $name: type_of!($read),)*
            $($(#[$doc])* pub $made: $type,)*
        }

        impl Parameters {
            /// Reads the parameters of the family from a checked set.
            pub fn new($variant: Variant, $given: &ResetParameters) -> Self {
                Parameters {
                    $($name: $given.$read(stringify!($name) $(, $default)?),)*
                    $($made: $value,)*
                }
            }
        }
    };
}
pub(crate) use typed_parameters;
