//! The serialisation of ROS 1: little-endian, without alignment, text without an end mark.

use super::{Sink, Source, WireError};

/// Reads fields of ROS 1.
#[derive(Clone, Debug)]
pub struct Ros1Reader<'a>(&'a [u8]);

impl<'a> Ros1Reader<'a> {
    /// From the beginning of a message.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], WireError> {
        let short = WireError::Short { field, left: self.0.len() };
        let (array, rest) = self.0.split_first_chunk::<N>().ok_or(short)?;
        self.0 = rest;
        Ok(*array)
    }
}

impl<'a> Source<'a> for Ros1Reader<'a> {
    const IS_ROS1: bool = true;

    fn left(&self) -> usize {
        self.0.len()
    }

    fn raw(&mut self, field: &'static str, count: usize) -> Result<&'a [u8], WireError> {
        let short = WireError::Short { field, left: self.0.len() };
        let (bytes, rest) = self.0.split_at_checked(count).ok_or(short)?;
        self.0 = rest;
        Ok(bytes)
    }

    fn u16(&mut self, field: &'static str) -> Result<u16, WireError> {
        self.array(field).map(u16::from_le_bytes)
    }

    fn u32(&mut self, field: &'static str) -> Result<u32, WireError> {
        self.array(field).map(u32::from_le_bytes)
    }

    fn u64(&mut self, field: &'static str) -> Result<u64, WireError> {
        self.array(field).map(u64::from_le_bytes)
    }
}

/// Writes fields of ROS 1.
#[derive(Clone, Debug, Default)]
pub struct Ros1Writer(Vec<u8>);

impl Ros1Writer {
    /// What was written.
    pub fn finish(self) -> Vec<u8> {
        self.0
    }
}

impl Sink for Ros1Writer {
    const IS_ROS1: bool = true;

    fn raw(&mut self, bytes: &[u8]) {
        self.0.extend_from_slice(bytes);
    }

    fn u16(&mut self, value: u16) {
        self.raw(&value.to_le_bytes());
    }

    fn u32(&mut self, value: u32) {
        self.raw(&value.to_le_bytes());
    }

    fn u64(&mut self, value: u64) {
        self.raw(&value.to_le_bytes());
    }
}
