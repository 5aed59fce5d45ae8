//! What a deployer pushes, as data: `package.xml` ([`manifest`]) and the interface of the running package
//! ([`interface`]). Reads files, does nothing else.

pub mod interface;
