//! Enumerations whose values have names.

/// Declares an enumeration whose values have one name each, on the command line and in messages: with `ALL`, `name`, `Display` and, if
/// it ends with `else` and the error for an unknown name, `FromStr`.
#[doc(hidden)]
#[macro_export]
macro_rules! named_enum {
    (
        $(#[$attribute:meta])*
        pub enum $name:ident { $($(#[$of_variant:meta])* $variant:ident = $text:literal,)+ }
        $(else |$given:ident| -> $error:ty $otherwise:block)?
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name {
            $($(#[$of_variant])* $variant,)+
        }

        impl $name {
            /// All values, in this order.
            pub const ALL: [Self; [$($text),+].len()] = [$(Self::$variant),+];

            /// Its name.
            #[must_use]
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $text,)+
                }
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(self.name())
            }
        }

        $(impl std::str::FromStr for $name {
            type Err = $error;

            fn from_str($given: &str) -> Result<Self, $error> {
                let found = Self::ALL.into_iter().find(|value| value.name() == $given);
                found.ok_or_else(|| $otherwise)
            }
        })?
    };
}
