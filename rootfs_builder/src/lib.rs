//! rootfs_builder
