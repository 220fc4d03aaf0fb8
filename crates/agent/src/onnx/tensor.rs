//! Arrays of an ONNX graph.

/// Most entries of an array that an operation computes. Weights may be larger: they are in the file.
const MAX_LEN: usize = 1 << 22;

/// Array of floats or of integers, row-major.
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
    /// Floats.
    Float(Vec<f32>),
    /// Integers, such as shapes and indices; truth values are 0 and 1.
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

    /// Returns the number of entries.
    pub fn len(&self) -> usize {
        match &self.data {
            Data::Float(values) => values.len(),
            Data::Integer(values) => values.len(),
        }
    }

    /// Returns the floats.
    pub fn as_floats(&self) -> Result<&[f32], String> {
        if let Data::Float(values) = &self.data {
            Ok(values)
        } else {
            Err("has integers where floats are expected".to_owned())
        }
    }

    /// Returns the integers.
    pub fn as_integers(&self) -> Result<&[i64], String> {
        if let Data::Integer(values) = &self.data {
            Ok(values)
        } else {
            Err("has floats where integers are expected".to_owned())
        }
    }

    /// Returns the entries as floats.
    pub fn to_floats(&self) -> Vec<f32> {
        match &self.data {
            Data::Float(values) => values.clone(),
            Data::Integer(values) => values.iter().map(|value| *value as f32).collect(),
        }
    }

    /// Returns the array with another shape of as many entries.
    pub fn reshaped(&self, shape: Vec<usize>) -> Result<Self, String> {
        check_len(&shape, self.len())?;
        Ok(Self { shape, data: self.data.clone() })
    }

    /// Returns an array of the same kind whose entry `i` is entry `index(i)` of this one. The indices must exist.
    pub fn picked(&self, shape: Vec<usize>, index: impl Fn(usize) -> usize) -> Result<Self, String> {
        let count = len(&shape)?;
        let data = match &self.data {
            Data::Float(values) => Data::Float((0..count).map(|entry| values[index(entry)]).collect()),
            Data::Integer(values) => Data::Integer((0..count).map(|entry| values[index(entry)]).collect()),
        };
        Ok(Self { shape, data })
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
    let refused = || format!("makes an array with the dimensions {shape:?}, longer than {MAX_LEN} numbers");
    product.filter(|len| *len <= MAX_LEN).ok_or_else(refused)
}

fn check_len(shape: &[usize], given: usize) -> Result<(), String> {
    if shape.iter().try_fold(1usize, |product, len| product.checked_mul(*len)) == Some(given) {
        Ok(())
    } else {
        Err(format!("has {given} entries for the dimensions {shape:?}"))
    }
}

/// Returns the shape of a result of which each dimension of 1 is repeated, as in NumPy.
pub fn broadcast_shape(a: &[usize], b: &[usize]) -> Result<Vec<usize>, String> {
    let rank = a.len().max(b.len());
    let padded = |shape: &[usize]| [&vec![1; rank - shape.len()], shape].concat();
    let one = |(a, b): (usize, usize)| match (a, b) {
        (a, b) if a == b || b == 1 => Ok(a),
        (1, b) => Ok(b),
        _ => Err(format!("has the dimensions {a:?} and {b:?}, which do not fit")),
    };
    padded(a).into_iter().zip(padded(b)).map(one).collect()
}

/// Returns the array with its dimensions of 1 repeated to a shape of [`broadcast_shape`].
pub fn repeated(tensor: &Tensor, shape: &[usize]) -> Result<Tensor, String> {
    if tensor.shape == shape {
        return Ok(tensor.clone());
    }
    let missing = shape.len().saturating_sub(tensor.shape.len());
    let own = [&vec![1; missing], &tensor.shape[..]].concat();
    let fits = own.len() == shape.len() && own.iter().zip(shape).all(|(own, len)| own == len || *own == 1);
    if !fits {
        return Err(format!("has the dimensions {:?}, which do not become {shape:?}", tensor.shape));
    }
    let index = |mut position: usize| {
        let (mut index, mut stride) = (0, 1);
        for (len, own) in shape.iter().zip(&own).rev() {
            index += if *own == 1 { 0 } else { position % len * stride };
            (position, stride) = (position / len, stride * own);
        }
        index
    };
    tensor.picked(shape.to_vec(), index)
}
