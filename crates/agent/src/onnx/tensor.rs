//! Arrays of an ONNX graph.

/// Most entries of an array.
const MAX_LEN: usize = 1 << 26;

/// Array of 32-bit floats or of integers, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Length of each dimension.
    pub shape: Vec<usize>,
    /// Entries.
    pub data: Data,
}

/// Entries of an array.
#[derive(Clone, Debug, PartialEq)]
pub enum Data {
    /// 32-bit floats.
    Float(Vec<f32>),
    /// 64-bit integers, such as shapes and indices.
    Integer(Vec<i64>),
}

impl Tensor {
    /// Creates an array of floats. Fails if the number of entries is not that of the shape.
    pub fn floats(shape: Vec<usize>, values: Vec<f32>) -> Result<Self, String> {
        check_len(&shape, values.len())?;
        Ok(Self { shape, data: Data::Float(values) })
    }

    /// Creates an array of integers. Fails if the number of entries is not that of the shape.
    pub fn integers(shape: Vec<usize>, values: Vec<i64>) -> Result<Self, String> {
        check_len(&shape, values.len())?;
        Ok(Self { shape, data: Data::Integer(values) })
    }

    /// Returns the floats.
    pub fn as_floats(&self) -> Result<&[f32], String> {
        if let Data::Float(values) = &self.data {
            Ok(values)
        } else {
            Err("integers where floats are expected".to_owned())
        }
    }

    /// Returns the integers.
    pub fn as_integers(&self) -> Result<&[i64], String> {
        if let Data::Integer(values) = &self.data {
            Ok(values)
        } else {
            Err("floats where integers are expected".to_owned())
        }
    }

    /// Returns the array with another shape of as many entries.
    pub fn reshaped(&self, shape: Vec<usize>) -> Result<Self, String> {
        let len = match &self.data {
            Data::Float(values) => values.len(),
            Data::Integer(values) => values.len(),
        };
        check_len(&shape, len)?;
        Ok(Self { shape, data: self.data.clone() })
    }

    /// Returns the index of a dimension; negative ones count from the end.
    pub fn axis(&self, axis: i64) -> Result<usize, String> {
        let rank = self.shape.len() as i64;
        let index = if axis < 0 { axis + rank } else { axis };
        if (0..rank).contains(&index) { Ok(index as usize) } else { Err(format!("axis {axis} of {rank} dimensions")) }
    }

    /// Returns the number of entries before, in and behind a dimension.
    pub fn split_at(&self, axis: usize) -> [usize; 3] {
        let product = |dimensions: &[usize]| dimensions.iter().product();
        [product(&self.shape[..axis]), self.shape[axis], product(&self.shape[axis + 1..])]
    }
}

/// Returns the number of entries of a shape. Fails if it is too large.
pub fn len(shape: &[usize]) -> Result<usize, String> {
    let product = shape.iter().try_fold(1usize, |product, len| product.checked_mul(*len));
    product.filter(|len| *len <= MAX_LEN).ok_or_else(|| format!("an array with the dimensions {shape:?}"))
}

fn check_len(shape: &[usize], given: usize) -> Result<(), String> {
    if len(shape)? == given { Ok(()) } else { Err(format!("{given} entries for the dimensions {shape:?}")) }
}

/// Returns `f` of each pair of entries, where a dimension of 1 is repeated, as in NumPy.
pub fn broadcast(a: &Tensor, b: &Tensor, f: impl Fn(f32, f32) -> f32) -> Result<Tensor, String> {
    let rank = a.shape.len().max(b.shape.len());
    let padded = |shape: &[usize]| [&vec![1; rank - shape.len()], shape].concat();
    let (shape_a, shape_b) = (padded(&a.shape), padded(&b.shape));
    let mut shape = Vec::with_capacity(rank);
    for (a, b) in shape_a.iter().zip(&shape_b) {
        match (*a, *b) {
            (a, b) if a == b || b == 1 => shape.push(a),
            (1, b) => shape.push(b),
            _ => return Err(format!("the dimensions {shape_a:?} and {shape_b:?} do not fit")),
        }
    }
    let (values_a, values_b) = (a.as_floats()?, b.as_floats()?);
    let index = |mut position: usize, own: &[usize]| {
        let (mut index, mut stride) = (0, 1);
        for (len, own) in shape.iter().zip(own).rev() {
            index += if *own == 1 { 0 } else { position % len * stride };
            (position, stride) = (position / len, stride * own);
        }
        index
    };
    let pair = |position| f(values_a[index(position, &shape_a)], values_b[index(position, &shape_b)]);
    let values = (0..len(&shape)?).map(pair).collect();
    Tensor::floats(shape, values)
}
