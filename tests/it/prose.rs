//! Sentences of the documents: 25 words at most, 15 on average.

use std::path::{Path, PathBuf};

use twinstep_tests::python::root;

/// Longest sentence, and the longest mean of a page [words].
const LONGEST: usize = 25;
const LONGEST_MEAN: f64 = 15.0;
/// A page with fewer sentences has no mean.
const LEAST_SENTENCES: usize = 10;

/// Returns the pages that people write: the lists of papers and of the changes are no sentences, other tables are generated.
fn pages() -> Vec<PathBuf> {
    let mut pages: Vec<PathBuf> =
        ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "protocol/SPEC.md", "clients/python/README.md"]
            .map(|page| root().join(page))
            .to_vec();
    let in_folder = |folder: &str| {
        let entries = std::fs::read_dir(root().join(folder)).unwrap().map(|entry| entry.unwrap().path());
        entries.filter(|path| path.extension().is_some_and(|extension| extension == "md")).collect::<Vec<_>>()
    };
    pages.extend(in_folder("docs").into_iter().filter(|path| !path.ends_with("references.md")));
    let crates = std::fs::read_dir(root().join("crates")).unwrap().map(|entry| entry.unwrap().path().join("README.md"));
    pages.extend(crates);
    pages
}

/// Returns the text of Markdown by paragraph and list item, without code, tables, headings and addresses.
fn paragraphs(text: &str) -> Vec<String> {
    let mut found = vec![String::new()];
    let mut in_code = false;
    for line in text.lines() {
        let start = line.trim_start();
        if start.starts_with("```") {
            in_code = !in_code;
        }
        let is_item = start.starts_with("- ")
            || start.starts_with("* ")
            || start.split_once(". ").is_some_and(|(number, _)| number.parse::<u32>().is_ok());
        if start.is_empty() || is_item {
            found.push(String::new());
        }
        if !in_code && !start.starts_with(['|', '#', '!']) && !start.starts_with("```") {
            let last = found.len() - 1;
            found[last].push(' ');
            found[last].push_str(line);
        }
    }
    found.iter().map(|paragraph| without_code(&without_addresses(paragraph))).collect()
}

/// Returns the text with each piece of code as one word.
fn without_code(text: &str) -> String {
    text.split('`').enumerate().map(|(index, part)| if index % 2 == 0 { part } else { "X" }).collect()
}

/// Returns the text with links as what they say.
fn without_addresses(text: &str) -> String {
    let mut parts = text.split("](");
    let mut whole = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        whole += part.split_once(')').map_or(part, |(_, rest)| rest);
    }
    whole.replace('[', "")
}

/// Returns the sentences of a page, with the number of words of each.
fn sentences(text: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    for paragraph in paragraphs(text) {
        let words: Vec<&str> = paragraph.split_whitespace().collect();
        let mut start = 0;
        for (index, word) in words.iter().enumerate() {
            let ends = word.ends_with(['.', '!', '?', ':', ';']);
            let begins = words
                .get(index + 1)
                .is_none_or(|next| next.starts_with(|first: char| first.is_ascii_uppercase() || first == '"'));
            if index + 1 == words.len() || (ends && begins) {
                let sentence = &words[start..=index];
                let count =
                    sentence.iter().filter(|word| word.contains(|one: char| one.is_ascii_alphanumeric())).count();
                if count > 0 {
                    found.push((count, sentence.join(" ")));
                }
                start = index + 1;
            }
        }
    }
    found
}

fn check(page: &Path) {
    let all = sentences(&std::fs::read_to_string(page).unwrap());
    for (words, sentence) in &all {
        assert!(*words <= LONGEST, "{}: {words} words: {sentence}", page.display());
    }
    let mean = all.iter().map(|(words, _)| *words as f64).sum::<f64>() / all.len().max(1) as f64;
    assert!(all.len() < LEAST_SENTENCES || mean <= LONGEST_MEAN, "{}: {mean:.1} words a sentence", page.display());
}

#[test]
fn sentences_are_short() {
    for page in pages() {
        check(&page);
    }
}

#[test]
fn sentences_of_a_page_are_counted_without_code_tables_and_addresses() {
    let page = "# A heading\n\nOne two three. Four [five](a.md) `six seven`.\n\n| a | table |\n\n```sh\ncode here\n```\n- An item\n  of five words.\n";
    let counts: Vec<usize> = sentences(page).into_iter().map(|(words, _)| words).collect();
    assert_eq!(counts, [3, 3, 5]);
}
