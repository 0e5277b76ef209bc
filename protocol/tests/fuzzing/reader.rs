//! Bytes as a source of choices. Beyond the end every choice is 0, so that every string of bytes is a story.

/// Numbers at and beyond every limit.
const NUMBERS: [f64; 16] = [
    0.0,
    1.0,
    -1.0,
    0.5,
    0.01,
    1e-9,
    1e-12,
    99.0,
    1e6,
    1e9,
    1e300,
    f64::MAX,
    f64::MIN_POSITIVE,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::NAN,
];

pub struct Reader<'a> {
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    pub fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.bytes.split_first() else { return 0 };
        self.bytes = rest;
        *first
    }

    pub fn u64(&mut self) -> u64 {
        u64::from_le_bytes(core::array::from_fn(|_| self.byte()))
    }

    /// A number below `n`, which is at most 256.
    pub fn below(&mut self, n: usize) -> usize {
        usize::from(self.byte()) % n.max(1)
    }

    pub fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == n - 1
    }

    pub fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }

    /// One of `list`, if it has any.
    pub fn choose<'b, T>(&mut self, list: &'b [T]) -> Option<&'b T> {
        let place = self.below(256);
        list.get(place % list.len().max(1))
    }

    /// As many bytes as are left of these.
    pub fn bytes(&mut self, len: usize) -> &'a [u8] {
        let (taken, rest) = self.bytes.split_at(len.min(self.bytes.len()));
        self.bytes = rest;
        taken
    }

    /// Mostly a small number; else one that is hard to bear, or any bits at all.
    pub fn number(&mut self) -> f64 {
        match self.byte() {
            n @ 0..=199 => (f64::from(n) - 100.0) * 0.05,
            n @ 200..=247 => NUMBERS[usize::from(n) % NUMBERS.len()],
            _ => f64::from_bits(self.u64()),
        }
    }

    pub fn numbers<const N: usize>(&mut self) -> [f64; N] {
        core::array::from_fn(|_| self.number())
    }

    /// `bytes`, mostly as they are; else cut, continued, damaged, or with a length that claims the world.
    pub fn mangled(&mut self, mut bytes: Vec<u8>) -> Vec<u8> {
        let way = self.byte();
        if way < 160 || bytes.is_empty() {
            return bytes;
        }
        let at = (self.byte() as usize * 256 + self.byte() as usize) % bytes.len();
        match way % 8 {
            0 => bytes.truncate(at),
            1 => bytes[at] ^= 1 << (at % 8),
            2 => bytes[at] = self.byte(),
            3 => bytes.extend_from_slice(self.bytes(usize::from(way))),
            // 2^30, 2^64 − 1, and a zero that takes two bytes, as varints.
            4 => drop(bytes.splice(at..=at, [128, 128, 128, 128, 4])),
            5 => drop(bytes.splice(at..=at, [255, 255, 255, 255, 255, 255, 255, 255, 255, 1])),
            6 => drop(bytes.splice(at..=at, [bytes[at] | 128, 0])),
            _ => bytes.extend_from_within(at..),
        }
        bytes
    }
}
