//! How large a cloud may be.

/// Points read from one cloud at most: eight times a full turn of a 64-line LiDAR.
pub const POINTS_MAX: usize = 1_000_000;
/// Bytes read from one cloud at most: [`POINTS_MAX`] points of 128 bytes.
pub const CLOUD_BYTES_MAX: u64 = 128_000_000;
/// Memory for unpacking `.xz`, bytes: twice the 64 MiB of `xz -9`. A file states how large a dictionary it wants, up to
/// 4 GiB.
pub const UNPACKING_BYTES_MAX: u64 = 128 << 20;
