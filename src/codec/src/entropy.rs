//! The entropy coders that the codecs share.
//!
//! [`tans`] codes many symbols at close to memory speed: counts are taken first, then every context gets its own table
//! of an asymmetric numeral system (J. Duda, "Asymmetric numeral systems", arXiv:1311.2540, the tabled variant).
//! [`binary`] codes few decisions with adaptive probabilities (the range coder of G. N. N. Martin).

pub(crate) mod binary;
pub(crate) mod bits;
pub(crate) mod counts;
pub(crate) mod tans;
