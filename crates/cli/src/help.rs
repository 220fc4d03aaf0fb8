//! The list of commands in `twinstep --help`, in groups.

use clap::Command;

/// Groups of commands: heading, and names in the order in which they are used.
const GROUPS: [(&str, &[&str]); 4] = [
    ("Train a policy", &["demo", "train", "evaluate-policy", "serve", "list"]),
    (
        "Run a policy, simulated or on the real robot",
        &["run", "import-policy", "view", "robot", "preflight", "fake-robot"],
    ),
    (
        "Compare the simulation with measurements, and correct it",
        &["log", "play", "evaluate", "diagnose", "identify", "adapt", "excite", "spi-active", "fit", "u2e"],
    ),
    ("Look up and check", &["effects", "mjcf", "hunt", "bench"]),
];
/// Column in which descriptions begin, and the last one of a line.
const COLUMNS: [usize; 2] = [19, 80];
/// Bold and underlined, as other headings of the help; a terminal without styles does not get it.
const HEADING: [&str; 2] = ["\x1b[1;4m", "\x1b[0m"];

/// Returns the command with its subcommands in groups.
pub fn grouped(command: Command) -> Command {
    let about = |name: &str| {
        let found = command.find_subcommand(name).and_then(Command::get_about);
        found.map_or(String::new(), ToString::to_string)
    };
    let [on, off] = HEADING;
    let group = |(heading, names): &(&str, &[&str])| {
        let lines = names.iter().map(|name| line(name, &about(name)));
        format!("{on}{heading}:{off}\n{}", lines.collect::<Vec<_>>().join("\n"))
    };
    let groups = GROUPS.iter().map(group).collect::<Vec<_>>().join("\n\n");
    let more = "`twinstep COMMAND --help` explains a command, with an example.";
    command.help_template(format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{groups}\n\n{on}Options:{off}\n{{options}}\n\n{more}\n"
    ))
}

/// Returns a command with its description, whose lines begin in one column.
fn line(name: &str, about: &str) -> String {
    let [first, last] = COLUMNS;
    let mut lines = vec![format!("  {name:<width$}", width = first - 2)];
    for word in about.trim_end_matches('.').split_whitespace() {
        let now = lines.last_mut().expect("a first line");
        if now.chars().count() + word.chars().count() < last {
            if !now.ends_with(' ') {
                now.push(' ');
            }
            now.push_str(word);
        } else {
            lines.push(format!("{}{word}", " ".repeat(first)));
        }
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn long_descriptions_go_on_in_their_column() {
        let long = line("serve", &"a word of five ".repeat(6));
        assert!(long.lines().all(|line| line.len() <= 80), "{long}");
        assert!(long.lines().skip(1).all(|line| line.starts_with(&" ".repeat(19))), "{long}");
    }

    #[test]
    fn every_command_is_in_one_group() {
        let command = crate::Cli::command();
        let mut named: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        let mut visible: Vec<&str> =
            command.get_subcommands().filter(|one| !one.is_hide_set()).map(Command::get_name).collect();
        named.sort_unstable();
        visible.sort_unstable();
        assert_eq!(named, visible);
    }
}
