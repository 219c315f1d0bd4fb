//! Values for some pixels of a frame.

/// Side of a tile: the one of blocks of pixels, so that none shares a tile with another.
pub(crate) const TILE: usize = 8;

/// A value for every pixel of a frame, stored for the 8 x 8 tiles in which any was set.
#[derive(Clone, Debug)]
pub(crate) struct Tiles<T> {
    columns: usize,
    /// Per tile of the frame, 0 or one more than its place in `values`.
    places: Vec<u32>,
    values: Vec<[T; TILE * TILE]>,
}

impl<T: Copy + Default> Tiles<T> {
    pub(crate) fn new(width: usize, height: usize) -> Self {
        let columns = width.div_ceil(TILE);
        Self {
            columns,
            places: vec![0; columns * height.div_ceil(TILE)],
            values: Vec::new(),
        }
    }

    /// The value of a pixel; the default where none was set.
    pub(crate) fn get(&self, x: usize, y: usize) -> T {
        match self.places[y / TILE * self.columns + x / TILE] {
            0 => T::default(),
            place => self.values[place as usize - 1][y % TILE * TILE + x % TILE],
        }
    }

    pub(crate) fn set(&mut self, x: usize, y: usize, value: T) {
        let place = &mut self.places[y / TILE * self.columns + x / TILE];
        if *place == 0 {
            self.values.push([T::default(); TILE * TILE]);
            *place = self.values.len() as u32;
        }
        self.values[*place as usize - 1][y % TILE * TILE + x % TILE] = value;
    }

    pub(crate) fn bytes(&self) -> usize {
        self.places.capacity() * size_of::<u32>()
            + self.values.capacity() * size_of::<[T; TILE * TILE]>()
    }
}
