//! Operators that compute an entry of the result from one entry of each input.

use super::Operation;
use crate::onnx::graph::{BOOL, DOUBLE, FLOAT, INT32, INT64};
use crate::onnx::tensor::{Data, Tensor, broadcast_shape, repeated};

type Outputs = Result<Vec<Tensor>, String>;

/// Evaluates an operation of this family. Returns `None` for another one.
pub fn evaluate(operation: &Operation) -> Option<Outputs> {
    let name = operation.node.operator.as_str();
    let one = match name {
        // With `fmod` the remainder has the sign of the dividend, as in C.
        "Mod" if operation.integer("fmod", 0) != 0 => pairs(operation, |a, b| a % b, i64::checked_rem),
        "Identity" | "Dropout" => operation.input(0).cloned(),
        "Clip" => clip(operation),
        "Cast" => operation.input(0).and_then(|x| cast(x, operation.integer("to", 0))),
        "CastLike" => operation.input(1).and_then(|like| {
            let kind = if like.as_floats().is_ok() { FLOAT } else { INT64 };
            cast(operation.input(0)?, kind)
        }),
        "Where" => choose(operation),
        "PRelu" => pairs(operation, |x, slope| if x < 0.0 { slope * x } else { x }, |_, _| None),
        _ => match (activation(operation), binary(name)) {
            (Some(f), _) => each(operation, f),
            (None, Some((floats, integers))) => pairs(operation, floats, integers),
            (None, None) => match name {
                "Equal" => compare(operation, |a, b| a == b, |a, b| a == b),
                "Less" => compare(operation, |a, b| a < b, |a, b| a < b),
                "LessOrEqual" => compare(operation, |a, b| a <= b, |a, b| a <= b),
                "Greater" => compare(operation, |a, b| a > b, |a, b| a > b),
                "GreaterOrEqual" => compare(operation, |a, b| a >= b, |a, b| a >= b),
                "And" => compare(operation, |_, _| false, |a, b| a != 0 && b != 0),
                "Or" => compare(operation, |_, _| false, |a, b| a != 0 || b != 0),
                "Xor" => compare(operation, |_, _| false, |a, b| (a != 0) != (b != 0)),
                "Not" => operation.input(0).and_then(|x| {
                    Tensor::integers(x.shape.clone(), x.as_integers()?.iter().map(|x| i64::from(*x == 0)).collect())
                }),
                "IsNaN" => operation.input(0).and_then(|x| {
                    Tensor::integers(x.shape.clone(), x.as_floats()?.iter().map(|x| i64::from(x.is_nan())).collect())
                }),
                "Mean" => mean(operation),
                _ => return None,
            },
        },
    };
    Some(one.map(|one| vec![one]))
}

/// Returns a function of one float, with the attributes of the operation.
fn activation(operation: &Operation) -> Option<Box<dyn Fn(f32) -> f32>> {
    recurrent_activation(
        &operation.node.operator,
        &[
            operation.node.attributes.get("alpha").and_then(|one| one.float),
            operation.node.attributes.get("beta").and_then(|one| one.float),
            operation.node.attributes.get("gamma").and_then(|one| one.float),
            (operation.text("approximate") == Some("tanh")).then_some(1.0),
        ],
    )
}

/// Returns a function of one float by the name of its operator. `parameters` are alpha, beta and gamma; `None` is the default.
pub fn recurrent_activation(name: &str, parameters: &[Option<f32>]) -> Option<Box<dyn Fn(f32) -> f32>> {
    let parameter = |index: usize, default: f32| parameters.get(index).copied().flatten().unwrap_or(default);
    let sigmoid = |x: f32| 1.0 / (1.0 + (-x).exp());
    // ln(1 + eˣ) without overflow.
    let softplus = |x: f32| x.max(0.0) + (-x.abs()).exp().ln_1p();
    Some(match name {
        "Abs" => Box::new(f32::abs),
        "Neg" => Box::new(|x| -x),
        "Exp" => Box::new(f32::exp),
        "Log" => Box::new(f32::ln),
        "Sqrt" => Box::new(f32::sqrt),
        "Reciprocal" => Box::new(f32::recip),
        "Sin" => Box::new(f32::sin),
        "Cos" => Box::new(f32::cos),
        "Tan" => Box::new(f32::tan),
        "Asin" => Box::new(f32::asin),
        "Acos" => Box::new(f32::acos),
        "Atan" => Box::new(f32::atan),
        "Sinh" => Box::new(f32::sinh),
        "Cosh" => Box::new(f32::cosh),
        "Tanh" => Box::new(f32::tanh),
        "Asinh" => Box::new(f32::asinh),
        "Acosh" => Box::new(f32::acosh),
        "Atanh" => Box::new(f32::atanh),
        "Floor" => Box::new(f32::floor),
        "Ceil" => Box::new(f32::ceil),
        "Round" => Box::new(f32::round_ties_even),
        "Sign" => Box::new(|x| if x == 0.0 || x.is_nan() { x } else { x.signum() }),
        "Erf" => Box::new(erf),
        "Relu" => Box::new(|x| if x < 0.0 { 0.0 } else { x }),
        "Sigmoid" => Box::new(sigmoid),
        "Softplus" => Box::new(softplus),
        "Softsign" => Box::new(|x| x / (1.0 + x.abs())),
        "Mish" => Box::new(move |x| x * softplus(x).tanh()),
        "HardSwish" => Box::new(|x| x * (x / 6.0 + 0.5).clamp(0.0, 1.0)),
        "Gelu" if parameter(3, 0.0) > 0.0 => {
            Box::new(|x| 0.5 * x * (1.0 + (0.797_884_6 * (x + 0.044_715 * x * x * x)).tanh()))
        }
        "Gelu" => Box::new(|x| 0.5 * x * (1.0 + erf(x * std::f32::consts::FRAC_1_SQRT_2))),
        "Swish" => {
            let alpha = parameter(0, 1.0);
            Box::new(move |x| x * sigmoid(alpha * x))
        }
        "HardSigmoid" => {
            let (alpha, beta) = (parameter(0, 0.2), parameter(1, 0.5));
            Box::new(move |x| (alpha * x + beta).clamp(0.0, 1.0))
        }
        "LeakyRelu" => {
            let alpha = parameter(0, 0.01);
            Box::new(move |x| if x < 0.0 { alpha * x } else { x })
        }
        "Elu" => {
            let alpha = parameter(0, 1.0);
            Box::new(move |x| if x < 0.0 { alpha * x.exp_m1() } else { x })
        }
        "Celu" => {
            let alpha = parameter(0, 1.0);
            Box::new(move |x| if x < 0.0 { alpha * (x / alpha).exp_m1() } else { x })
        }
        "Selu" => {
            let (alpha, gamma) = (parameter(0, 1.673_263_2), parameter(2, 1.050_701));
            Box::new(move |x| gamma * if x < 0.0 { alpha * x.exp_m1() } else { x })
        }
        "ThresholdedRelu" => {
            let alpha = parameter(0, 1.0);
            Box::new(move |x| if x > alpha { x } else { 0.0 })
        }
        _ => return None,
    })
}

/// Error function; relative error 1.2e-7 (Numerical Recipes, third edition, section 6.2.2).
fn erf(x: f32) -> f32 {
    let z = f64::from(x.abs());
    let t = 1.0 / (1.0 + 0.5 * z);
    let series = [
        0.170_872_77,
        -0.822_152_23,
        1.488_515_87,
        -1.135_203_98,
        0.278_868_07,
        -0.186_288_06,
        0.096_784_18,
        0.374_091_96,
        1.000_023_68,
        -1.265_512_23,
    ];
    let exponent = series.iter().fold(0.0, |sum, coefficient| sum * t + coefficient);
    let complement = t * (-z * z + exponent).exp();
    let value = 1.0 - complement;
    (if x < 0.0 { -value } else { value }) as f32
}

fn each(operation: &Operation, f: impl Fn(f32) -> f32) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let data = match &x.data {
        Data::Float(values) => Data::Float(values.iter().map(|value| f(*value)).collect()),
        Data::Integer(values) => Data::Integer(match operation.node.operator.as_str() {
            "Abs" => values.iter().map(|value| value.wrapping_abs()).collect(),
            "Neg" => values.iter().map(|value| value.wrapping_neg()).collect(),
            "Sign" => values.iter().map(|value| value.signum()).collect(),
            "Relu" => values.iter().map(|value| *value.max(&0)).collect(),
            _ => return Err("has integers where floats are expected".to_owned()),
        }),
    };
    Ok(Tensor { shape: x.shape.clone(), data })
}

type OfFloats = fn(f32, f32) -> f32;
/// `None`: not defined, such as a quotient by 0.
type OfIntegers = fn(i64, i64) -> Option<i64>;

fn binary(name: &str) -> Option<(OfFloats, OfIntegers)> {
    Some(match name {
        "Add" | "Sum" => (|a, b| a + b, |a, b| Some(a.wrapping_add(b))),
        "Sub" => (|a, b| a - b, |a, b| Some(a.wrapping_sub(b))),
        "Mul" => (|a, b| a * b, |a, b| Some(a.wrapping_mul(b))),
        // Integers are truncated towards 0, as in C.
        "Div" => (|a, b| a / b, i64::checked_div),
        "Mod" => (|a, b| a - b * (a / b).floor(), floored_remainder),
        "Pow" => (f32::powf, |a, b| Some((a as f64).powf(b as f64) as i64)),
        "Max" => (larger, |a, b| Some(a.max(b))),
        "Min" => (|a, b| -larger(-a, -b), |a, b| Some(a.min(b))),
        _ => return None,
    })
}

/// Returns the remainder with the sign of the divisor, as in Python.
fn floored_remainder(a: i64, b: i64) -> Option<i64> {
    let remainder = a.checked_rem(b)?;
    Some(if remainder != 0 && (remainder < 0) != (b < 0) { remainder + b } else { remainder })
}

/// Returns the larger number; NaN if one is NaN, as in NumPy.
fn larger(a: f32, b: f32) -> f32 {
    if a.is_nan() || b.is_nan() { f32::NAN } else { a.max(b) }
}

/// Folds all inputs.
fn pairs(operation: &Operation, floats: OfFloats, integers: OfIntegers) -> Result<Tensor, String> {
    let mut result = operation.input(0)?.clone();
    for index in 1..operation.inputs.len() {
        result = pair(&result, operation.input(index)?, floats, integers)?;
    }
    Ok(result)
}

fn pair(a: &Tensor, b: &Tensor, floats: OfFloats, integers: OfIntegers) -> Result<Tensor, String> {
    let shape = broadcast_shape(&a.shape, &b.shape)?;
    let (a, b) = (repeated(a, &shape)?, repeated(b, &shape)?);
    match (&a.data, &b.data) {
        (Data::Float(a), Data::Float(b)) => {
            Tensor::floats(shape, a.iter().zip(b).map(|(a, b)| floats(*a, *b)).collect())
        }
        (Data::Integer(a), Data::Integer(b)) => {
            let values: Option<Vec<i64>> = a.iter().zip(b).map(|(a, b)| integers(*a, *b)).collect();
            Tensor::integers(shape, values.ok_or("of these integers is not defined")?)
        }
        // An exponent may have another type than its base.
        _ => Tensor::floats(shape, a.to_floats().iter().zip(b.to_floats()).map(|(a, b)| floats(*a, b)).collect()),
    }
}

fn compare(
    operation: &Operation,
    floats: fn(f32, f32) -> bool,
    integers: fn(i64, i64) -> bool,
) -> Result<Tensor, String> {
    let (a, b) = (operation.input(0)?, operation.input(1)?);
    let shape = broadcast_shape(&a.shape, &b.shape)?;
    let (a, b) = (repeated(a, &shape)?, repeated(b, &shape)?);
    let values = match (&a.data, &b.data) {
        (Data::Float(a), Data::Float(b)) => a.iter().zip(b).map(|(a, b)| i64::from(floats(*a, *b))).collect(),
        (Data::Integer(a), Data::Integer(b)) => a.iter().zip(b).map(|(a, b)| i64::from(integers(*a, *b))).collect(),
        _ => return Err("compares floats with integers".to_owned()),
    };
    Tensor::integers(shape, values)
}

fn choose(operation: &Operation) -> Result<Tensor, String> {
    let (condition, yes, no) = (operation.input(0)?, operation.input(1)?, operation.input(2)?);
    let shape = broadcast_shape(&condition.shape, &broadcast_shape(&yes.shape, &no.shape)?)?;
    let (condition, yes, no) = (repeated(condition, &shape)?, repeated(yes, &shape)?, repeated(no, &shape)?);
    let condition = condition.as_integers()?;
    match (&yes.data, &no.data) {
        (Data::Float(yes), Data::Float(no)) => {
            let one = |entry: usize| if condition[entry] != 0 { yes[entry] } else { no[entry] };
            Tensor::floats(shape, (0..condition.len()).map(one).collect())
        }
        (Data::Integer(yes), Data::Integer(no)) => {
            let one = |entry: usize| if condition[entry] != 0 { yes[entry] } else { no[entry] };
            Tensor::integers(shape, (0..condition.len()).map(one).collect())
        }
        _ => Err("chooses between floats and integers".to_owned()),
    }
}

fn clip(operation: &Operation) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    if let Data::Integer(values) = &x.data {
        let bound = |index: usize, default: i64| match operation.optional(index) {
            Some(bound) => bound.as_integers()?.first().copied().ok_or_else(|| "has an empty bound".to_owned()),
            None => Ok(default),
        };
        let (low, high) = (bound(1, i64::MIN)?, bound(2, i64::MAX)?);
        return Tensor::integers(x.shape.clone(), values.iter().map(|x| *x.max(&low).min(&high)).collect());
    }
    let bound = |index: usize, name: &str, default: f32| match operation.optional(index) {
        Some(bound) => bound.as_floats()?.first().copied().ok_or_else(|| format!("has an empty `{name}`")),
        None => Ok(operation.float(name, default)),
    };
    let (low, high) = (bound(1, "min", f32::NEG_INFINITY)?, bound(2, "max", f32::INFINITY)?);
    // NaN stays NaN.
    let one = |x: &f32| if *x < low { low } else { *x };
    let one = |x: &f32| if one(x) > high { high } else { one(x) };
    Tensor::floats(x.shape.clone(), x.as_floats()?.iter().map(one).collect())
}

fn mean(operation: &Operation) -> Result<Tensor, String> {
    let mut sum = pairs(operation, |a, b| a + b, |_, _| None)?;
    let count = operation.inputs.len() as f32;
    match &mut sum.data {
        Data::Float(values) => values.iter_mut().for_each(|value| *value /= count),
        Data::Integer(_) => return Err("has integers where floats are expected".to_owned()),
    }
    Ok(sum)
}

fn cast(x: &Tensor, to: i64) -> Result<Tensor, String> {
    let shape = x.shape.clone();
    match (&x.data, to) {
        (_, FLOAT | DOUBLE) => Tensor::floats(shape, x.to_floats()),
        (Data::Float(values), BOOL) => Tensor::integers(shape, values.iter().map(|x| i64::from(*x != 0.0)).collect()),
        (Data::Integer(values), BOOL) => Tensor::integers(shape, values.iter().map(|x| i64::from(*x != 0)).collect()),
        (Data::Float(values), INT32 | INT64) => Tensor::integers(shape, values.iter().map(|x| *x as i64).collect()),
        (Data::Integer(_), INT32 | INT64) => Ok(x.clone()),
        _ => Err(format!("to type {to} is not supported; floats (1, 11), integers (6, 7) and truth values (9) are")),
    }
}
