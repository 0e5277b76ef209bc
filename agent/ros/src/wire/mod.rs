//! How messages are written: CDR of ROS 2 (XCDR1, either byte order, by [`hiroz_cdr`]) and what ROS 1 has in its place.
//! A message is declared once, as a list of [`Field`]s, and is read and written in both. Lengths are checked against
//! the bytes that are left before anything is allocated, so a message takes memory in proportion to its bytes.

mod cdr;
mod ros1;

pub use ros1::{Ros1Reader, Ros1Writer};

use crate::limits::MESSAGE_BYTES_MAX;
use hiroz_cdr::{BigEndian, CdrReader, CdrWriter, LittleEndian};
use thiserror::Error;

/// How the bytes of a topic's messages are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Serialization {
    /// ROS 2: a header of four bytes, then CDR.
    Cdr,
    /// ROS 1: little-endian, without alignment.
    Ros1,
}

/// Why bytes are no message of the expected type.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum WireError {
    /// The bytes end before the message does.
    #[error("{field}: the message ends early, {left} bytes before its end; is it of another type or cut off?")]
    Short {
        /// What was read.
        field: &'static str,
        /// Bytes that are left.
        left: usize,
    },
    /// Text that is not UTF-8, or a truth value that is neither 0 nor 1.
    #[error("{field}: {what}; is the message of another type?")]
    Value {
        /// What was read.
        field: &'static str,
        /// What it holds.
        what: String,
    },
    /// A list that claims more elements than its message can hold.
    #[error(
        "{field}: claims {count} elements, more than the {left} bytes that follow can hold; is the message of another type or cut off?"
    )]
    Count {
        /// What was read.
        field: &'static str,
        /// Elements claimed.
        count: u32,
        /// Bytes that are left.
        left: usize,
    },
    /// The four bytes before CDR are not those of plain CDR.
    #[error("begins with {0:02x?}, which is no plain CDR (00 00 or 00 01); only XCDR1 of fixed types is read")]
    Encapsulation([u8; 2]),
    /// Bytes are left when the message is read.
    #[error("{0} bytes are left after the message; is it of another type?")]
    Trailing(usize),
    /// More bytes than any message may have.
    #[error("the message has {0} bytes; at most {MESSAGE_BYTES_MAX} (MESSAGE_BYTES_MAX) are read")]
    Long(usize),
}

/// Where fields are read from.
pub trait Source<'a> {
    /// Whether this is ROS 1, which has another header.
    const IS_ROS1: bool;
    /// Bytes that are left.
    fn left(&self) -> usize;
    /// So many bytes.
    ///
    /// # Errors
    /// [`WireError::Short`], as of all that follow.
    fn raw(&mut self, field: &'static str, count: usize) -> Result<&'a [u8], WireError>;
    /// A number of one byte.
    ///
    /// # Errors
    /// See [`Source::raw`].
    fn u8(&mut self, field: &'static str) -> Result<u8, WireError> {
        Ok(self.raw(field, 1)?[0])
    }
    /// A number of two bytes.
    ///
    /// # Errors
    /// See [`Source::raw`].
    fn u16(&mut self, field: &'static str) -> Result<u16, WireError>;
    /// A number of four bytes.
    ///
    /// # Errors
    /// See [`Source::raw`].
    fn u32(&mut self, field: &'static str) -> Result<u32, WireError>;
    /// A number of eight bytes.
    ///
    /// # Errors
    /// See [`Source::raw`].
    fn u64(&mut self, field: &'static str) -> Result<u64, WireError>;
}

/// Where fields are written to.
pub trait Sink {
    /// Whether this is ROS 1.
    const IS_ROS1: bool;
    /// Bytes as they are.
    fn raw(&mut self, bytes: &[u8]);
    /// A number of two bytes.
    fn u16(&mut self, value: u16);
    /// A number of four bytes.
    fn u32(&mut self, value: u32);
    /// A number of eight bytes.
    fn u64(&mut self, value: u64);
}

/// What a message consists of.
pub trait Field: Sized {
    /// Bytes that it has at least, without alignment.
    const BYTES_MIN: usize;
    /// Reads it.
    ///
    /// # Errors
    /// [`WireError`], which names `field`.
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError>;
    /// Writes it.
    fn write<S: Sink>(&self, sink: &mut S);
}

/// A message with a name.
pub trait Message: Field {
    /// `package/Type`, as [`plain_type`] gives it.
    const TYPE: &'static str;

    /// Reads a whole message.
    ///
    /// # Errors
    /// [`WireError`].
    fn decode(serialization: Serialization, bytes: &[u8]) -> Result<Self, WireError> {
        if bytes.len() > MESSAGE_BYTES_MAX {
            return Err(WireError::Long(bytes.len()));
        }
        match serialization {
            Serialization::Ros1 => {
                let mut reader = Ros1Reader::new(bytes);
                let message = Self::read(&mut reader, Self::TYPE)?;
                match reader.left() {
                    0 => Ok(message),
                    left => Err(WireError::Trailing(left)),
                }
            }
            Serialization::Cdr => {
                let short = WireError::Short { field: Self::TYPE, left: bytes.len() };
                let (header, body) = bytes.split_at_checked(CDR_HEADER_LEN).ok_or(short)?;
                // Some writers pad the end to four bytes.
                let whole = |left: usize| if left < 4 { Ok(()) } else { Err(WireError::Trailing(left)) };
                match [header[0], header[1]] {
                    [0, 1] => {
                        let mut reader = CdrReader::<LittleEndian>::new(body);
                        let message = Self::read(&mut reader, Self::TYPE)?;
                        whole(reader.remaining()).map(|()| message)
                    }
                    [0, 0] => {
                        let mut reader = CdrReader::<BigEndian>::new(body);
                        let message = Self::read(&mut reader, Self::TYPE)?;
                        whole(reader.remaining()).map(|()| message)
                    }
                    other => Err(WireError::Encapsulation(other)),
                }
            }
        }
    }

    /// Writes a whole message; CDR is little-endian.
    fn encode(&self, serialization: Serialization) -> Vec<u8> {
        match serialization {
            Serialization::Ros1 => {
                let mut writer = Ros1Writer::default();
                self.write(&mut writer);
                writer.finish()
            }
            Serialization::Cdr => {
                let mut bytes = vec![0, 1, 0, 0];
                self.write(&mut CdrWriter::<LittleEndian>::new(&mut bytes));
                bytes
            }
        }
    }
}

/// Bytes before CDR: the encoding, and options.
pub const CDR_HEADER_LEN: usize = 4;

/// `nav_msgs/msg/Odometry` and `nav_msgs/Odometry` are one type; so are `tf/tfMessage` of old and `tf2_msgs/TFMessage`.
pub fn plain_type(name: &str) -> String {
    match name.replace("/msg/", "/").as_str() {
        "tf/tfMessage" => "tf2_msgs/TFMessage".into(),
        plain => plain.into(),
    }
}

macro_rules! number {
    ($($kind:ty, $bytes:literal, $get:ident;)*) => { $(
        impl Field for $kind {
            const BYTES_MIN: usize = $bytes;
            fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
                Ok(<$kind>::from_ne_bytes(source.$get(field)?.to_ne_bytes()))
            }
            fn write<S: Sink>(&self, sink: &mut S) {
                sink.$get($get::from_ne_bytes(self.to_ne_bytes()));
            }
        }
    )* };
}

number! {
    u16, 2, u16;
    i32, 4, u32;
    u32, 4, u32;
    f32, 4, u32;
    f64, 8, u64;
}

impl Field for u8 {
    const BYTES_MIN: usize = 1;
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
        source.u8(field)
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        sink.raw(&[*self]);
    }
}

impl Field for bool {
    const BYTES_MIN: usize = 1;
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
        match source.u8(field)? {
            0 => Ok(false),
            1 => Ok(true),
            other => Err(WireError::Value { field, what: format!("{other} is neither true (1) nor false (0)") }),
        }
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        sink.raw(&[u8::from(*self)]);
    }
}

impl Field for String {
    const BYTES_MIN: usize = 4;
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
        let length = source.u32(field)? as usize;
        let mut bytes = source.raw(field, length)?;
        if !S::IS_ROS1 {
            bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        }
        let text = std::str::from_utf8(bytes);
        text.map(Into::into).map_err(|error| WireError::Value { field, what: error.to_string() })
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        let end: &[u8] = if S::IS_ROS1 { &[] } else { &[0] };
        sink.u32(length(self.len() + end.len()));
        sink.raw(self.as_bytes());
        sink.raw(end);
    }
}

impl<const N: usize> Field for [f64; N] {
    const BYTES_MIN: usize = 8 * N;
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::read(source, field)?;
        }
        Ok(values)
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        self.iter().for_each(|value| value.write(sink));
    }
}

impl<T: Field> Field for Vec<T> {
    const BYTES_MIN: usize = 4;
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
        let count = source.u32(field)?;
        let left = source.left();
        if count as usize > left / T::BYTES_MIN {
            return Err(WireError::Count { field, count, left });
        }
        (0..count).map(|_| T::read(source, field)).collect()
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        sink.u32(length(self.len()));
        self.iter().for_each(|value| value.write(sink));
    }
}

/// Bytes of an image or a cloud, copied at once.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Blob(pub Vec<u8>);

impl std::fmt::Debug for Blob {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} bytes", self.0.len())
    }
}

impl Field for Blob {
    const BYTES_MIN: usize = 4;
    fn read<'a, S: Source<'a>>(source: &mut S, field: &'static str) -> Result<Self, WireError> {
        let count = source.u32(field)?;
        let left = source.left();
        if count as usize > left {
            return Err(WireError::Count { field, count, left });
        }
        Ok(Self(source.raw(field, count as usize)?.to_vec()))
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        sink.u32(length(self.0.len()));
        sink.raw(&self.0);
    }
}

/// Of what was read from a message, or is as small.
fn length(length: usize) -> u32 {
    u32::try_from(length).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests;
