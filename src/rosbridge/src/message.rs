//! Common interface of all ops.

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
