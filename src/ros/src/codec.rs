//! Serialized messages ⇄ JSON and CBOR.
