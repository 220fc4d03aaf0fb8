//! The files that are read.

use std::path::{Path, PathBuf};

use super::facts::Facts;
use super::yaml::Yaml;
use super::{deploy_yaml, isaac_lab, legged_gym, metadata, rl_gym, rl_sar};
use crate::error::{AgentError, torch_hint};
use crate::onnx::OnnxNetwork;

/// Largest config file.
const MAX_BYTES: u64 = 16 << 20;
/// Deepest folder below a given one, and most files, that are looked at.
const MAX_DEPTH: usize = 4;
const MAX_FILES: usize = 2000;

/// Configs, and the network that they belong to.
pub struct Sources {
    /// Files that are no networks.
    configs: Vec<PathBuf>,
    /// The network.
    pub network: Option<OnnxNetwork>,
    /// A network of PyTorch, if there is none in ONNX.
    torch: Option<PathBuf>,
}

impl Sources {
    /// Looks for networks and configs.
    pub fn find(paths: &[impl AsRef<Path>]) -> Result<Self, AgentError> {
        let (mut configs, mut networks, mut torch) = (Vec::new(), Vec::new(), Vec::new());
        for path in paths.iter().map(AsRef::as_ref) {
            let mut files = Vec::new();
            if path.is_dir() {
                walk(path, 0, &mut files);
                files.sort();
            } else {
                files.push(path.to_owned());
            }
            let is_given = !path.is_dir();
            for file in files {
                match file.extension().and_then(|end| end.to_str()).unwrap_or_default() {
                    "onnx" => networks.push(file),
                    "yaml" | "yml" => configs.push(file),
                    "pt" | "pth" | "jit" => torch.push(file),
                    "py" if is_given || text(&file).is_ok_and(|text| text.contains("default_joint_angles")) => {
                        configs.push(file);
                    }
                    _ if is_given => {
                        return Err(failed(
                            &file,
                            "a network (*.onnx), a config (*.yaml, *.py) or a folder is expected",
                        ));
                    }
                    _ => {}
                }
            }
        }
        if networks.len() > 1 {
            networks.retain(|path| path.file_name().is_some_and(|name| name == "policy.onnx"));
        }
        let network = match &networks[..] {
            [] => None,
            [path] => Some(OnnxNetwork::read(path)?),
            [first, ..] => return Err(failed(first, "there are several networks: name the one to import")),
        };
        let torch = torch.into_iter().next().filter(|_| network.is_none());
        if configs.is_empty() && network.is_none() {
            if let Some(torch) = torch {
                return Err(failed(&torch, &format!("it is a network of PyTorch{}", torch_hint(&torch))));
            }
            let path = paths.first().map(|path| path.as_ref().to_owned()).unwrap_or_default();
            return Err(failed(
                &path,
                "it has neither a network (*.onnx) nor a config (deploy.yaml, env.yaml, config.yaml, *.py)",
            ));
        }
        Ok(Self { configs, network, torch })
    }

    /// Reads all sources, the most specific first.
    pub fn facts(&self) -> Result<Vec<Facts>, AgentError> {
        let mut all: Vec<(usize, Facts)> = Vec::new();
        let inputs = self.network.as_ref().map(|network| network.inputs()[0].len());
        for path in &self.configs {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let content = text(path)?;
            let error = |reason: String| failed(path, &reason);
            if path.extension().is_some_and(|end| end == "py") {
                all.push((3, legged_gym::read(name, &content, inputs).map_err(error)?));
                continue;
            }
            let yaml = Yaml::parse(&content).map_err(|reason| failed(path, &format!("it is not YAML: {reason}")))?;
            if yaml.get("joint_ids_map").is_some() {
                all.push((0, deploy_yaml::read(name, &yaml).map_err(error)?));
            } else if is_isaac_lab(&yaml) {
                let agent = beside(path, "agent.yaml")?;
                all.push((1, isaac_lab::read(name, &yaml, agent.as_ref()).map_err(error)?));
            } else if let Some(env) = yaml.get("env").filter(|env| is_isaac_lab(env)) {
                // Hydra keeps both in one file.
                all.push((1, isaac_lab::read(name, env, yaml.get("agent")).map_err(error)?));
            } else if has(&yaml, "observations") && has(&yaml, "rl_kp") {
                let base =
                    beside(path, "base.yaml")?.map_or_else(|| beside(path, "../base.yaml"), |base| Ok(Some(base)))?;
                all.push((2, rl_sar::read(name, &yaml, base.as_ref()).map_err(error)?));
            } else if yaml.get("default_angles").is_some() && yaml.get("action_scale").is_some() {
                all.push((2, rl_gym::read(name, &yaml, inputs).map_err(error)?));
            }
        }
        if let Some(network) = &self.network {
            let name = network.path().file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let facts = metadata::read(name, network).map_err(|reason| failed(network.path(), &reason))?;
            all.extend(facts.map(|facts| (4, facts)));
        }
        all.sort_by_key(|(order, _)| *order);
        if all.is_empty() && !self.configs.is_empty() {
            let names: Vec<_> = self.configs.iter().map(|path| path.display().to_string()).collect();
            return Err(failed(
                &self.configs[0],
                &format!(
                    "no config of unitree_rl_lab (deploy.yaml), Isaac Lab (env.yaml), rl_sar (config.yaml), unitree_rl_gym (with default_angles) or legged_gym (*.py) is among {}",
                    names.join(", ")
                ),
            ));
        }
        if let Some(torch) = &self.torch {
            let name = torch.display();
            let notes = vec![format!("`run` needs the network {name} as ONNX{}", torch_hint(torch))];
            all.push((5, Facts { source: name.to_string(), notes, ..Facts::default() }));
        }
        Ok(all.into_iter().map(|(_, facts)| facts).collect())
    }
}

fn is_isaac_lab(yaml: &Yaml) -> bool {
    yaml.get("scene").is_some() && yaml.get("actions").is_some()
}

/// The settings may be below one name.
fn has(yaml: &Yaml, key: &str) -> bool {
    yaml.get(key).is_some() || yaml.entries().iter().any(|(_, value)| value.get(key).is_some())
}

fn walk(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for path in entries.flatten().map(|entry| entry.path()) {
        if files.len() >= MAX_FILES {
            return;
        }
        if path.is_dir() && depth < MAX_DEPTH {
            walk(&path, depth + 1, files);
        } else if path.is_file() {
            files.push(path);
        }
    }
}

fn beside(path: &Path, name: &str) -> Result<Option<Yaml>, AgentError> {
    let other = path.with_file_name(name);
    if !other.is_file() {
        return Ok(None);
    }
    Yaml::parse(&text(&other)?).map(Some).map_err(|reason| failed(&other, &format!("it is not YAML: {reason}")))
}

fn text(path: &Path) -> Result<String, AgentError> {
    let len = std::fs::metadata(path).map_err(|error| failed(path, &error.to_string()))?.len();
    if len > MAX_BYTES {
        return Err(failed(path, &format!("it has {len} bytes; a config has at most {MAX_BYTES}")));
    }
    std::fs::read_to_string(path).map_err(|error| failed(path, &error.to_string()))
}

fn failed(path: &Path, reason: &str) -> AgentError {
    AgentError::Import { path: path.to_owned(), reason: reason.to_owned() }
}
