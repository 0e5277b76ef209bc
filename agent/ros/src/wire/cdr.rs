//! CDR, by `hiroz-cdr`: it aligns, checks lengths against the input and allocates nothing of what is used here.

use super::{Sink, Source, WireError};
use hiroz_cdr::{BigEndian, CdrReader, CdrWriter, LittleEndian};

/// Byte orders are told apart by type.
macro_rules! cdr {
    ($order:ty) => {
        impl<'a> Source<'a> for CdrReader<'a, $order> {
            const IS_ROS1: bool = false;

            fn left(&self) -> usize {
                self.remaining()
            }

            fn raw(&mut self, field: &'static str, count: usize) -> Result<&'a [u8], WireError> {
                let left = self.remaining();
                self.read_bytes(count).map_err(|_| WireError::Short { field, left })
            }

            fn u16(&mut self, field: &'static str) -> Result<u16, WireError> {
                let left = self.remaining();
                self.read_u16().map_err(|_| WireError::Short { field, left })
            }

            fn u32(&mut self, field: &'static str) -> Result<u32, WireError> {
                let left = self.remaining();
                self.read_u32().map_err(|_| WireError::Short { field, left })
            }

            fn u64(&mut self, field: &'static str) -> Result<u64, WireError> {
                let left = self.remaining();
                self.read_u64().map_err(|_| WireError::Short { field, left })
            }
        }

        impl Sink for CdrWriter<'_, $order> {
            const IS_ROS1: bool = false;

            fn raw(&mut self, bytes: &[u8]) {
                self.buffer_mut().extend_from_slice(bytes);
            }

            fn u16(&mut self, value: u16) {
                self.write_u16(value);
            }

            fn u32(&mut self, value: u32) {
                self.write_u32(value);
            }

            fn u64(&mut self, value: u64) {
                self.write_u64(value);
            }
        }
    };
}

cdr!(LittleEndian);
cdr!(BigEndian);
