//! Common interface of all ops, and their declaration.

use crate::fields::Fields;
use crate::{Id, Problem, Writer};

/// Common interface of all ops.
pub(crate) trait Message<'a>: Sized {
    /// Value of the field `op`.
    const OP: &'static str;
    /// All fields that the protocol defines for it, apart from `op` and `id`.
    const FIELDS: &'static [&'static str];
    /// Reads the fields.
    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem>;
    /// Returns the `id` field.
    fn id(&self) -> Option<&Id<'a>>;
    /// Writes the fields, apart from `op` and `id`.
    fn write(&self, writer: &mut Writer<'_>);
}

/// Declares an op: its name, the kind of its id, and the name and kind of each field on the wire (see
/// [`field_kinds`](crate::field_kinds)), in the order in which they are written. `ignores` lists fields that clients
/// may send and the server does not use. `id: … => field` states that old clients append the id to that name.
macro_rules! message {
    (
        $(#[$doc:meta])*
        $name:ident $op:literal $(ignores [$($ignored:literal),+])?
        $(#[$id_doc:meta])*
        id: $id_type:ty = $id_kind:expr $(=> $named:ident)?,
        $($(#[$field_doc:meta])* $field:ident: $type:ty = $key:literal $kind:expr,)*
    ) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq)]
        pub struct $name<'a> {
            $(#[$id_doc])*
            pub id: $id_type,
            $($(#[$field_doc])* pub $field: $type,)*
        }

        impl<'a> $crate::message::Message<'a> for $name<'a> {
            const OP: &'static str = $op;
            const FIELDS: &'static [&'static str] = &[$($key,)* $($($ignored,)+)?];

            fn read(
                id: Option<$crate::Id<'a>>,
                fields: &$crate::fields::Fields<'a>,
            ) -> Result<Self, $crate::Problem> {
                use $crate::field_kinds::{FieldKind, IdKind};
                $(let $field = $kind.read(fields, $key)?;)*
                $(let ($named, id) = $crate::id::split_name($named, id);)?
                Ok(Self { id: $id_kind.read(id)?, $($field,)* })
            }

            fn id(&self) -> Option<&$crate::Id<'a>> {
                use $crate::field_kinds::IdKind;
                $id_kind.get(&self.id)
            }

            fn write(&self, writer: &mut $crate::Writer<'_>) {
                use $crate::field_kinds::FieldKind;
                $($kind.write(&self.$field, writer, $key);)*
            }
        }
    };
}
pub(crate) use message;
