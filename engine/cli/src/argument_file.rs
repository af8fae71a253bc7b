//! Arguments in a file: a command line has a limited length, 128 KiB for one argument and a few MB in all.

use std::ffi::OsString;

use super::failure::Failure;

/// Replaces each argument `@FILE` by the lines of that file, each an argument.
pub fn expand(arguments: impl IntoIterator<Item = OsString>) -> Result<Vec<OsString>, Failure> {
    let mut expanded = Vec::new();
    for argument in arguments {
        match argument.to_str().and_then(|argument| argument.strip_prefix('@')) {
            None => expanded.push(argument),
            Some(file) => {
                let text = std::fs::read_to_string(file)
                    .map_err(|error| format!("the file of arguments `{file}` cannot be read: {error}"))?;
                expanded.extend(text.lines().map(OsString::from));
            }
        }
    }
    Ok(expanded)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_file_are_arguments() {
        let path = std::env::temp_dir().join(format!("endless-arguments-{}", std::process::id()));
        std::fs::write(&path, "--seed=3\n--option=a=\"x y\"\n").unwrap();
        let given = ["serve".to_owned(), format!("@{}", path.display()), "a@b".to_owned()];
        let expanded = expand(given.map(OsString::from)).unwrap();
        std::fs::remove_file(&path).unwrap();
        assert_eq!(expanded, ["serve", "--seed=3", "--option=a=\"x y\"", "a@b"]);
        let error = expand([OsString::from("@/nowhere/at/all")]).unwrap_err().to_string();
        assert!(error.starts_with("the file of arguments `/nowhere/at/all` cannot be read"), "{error}");
    }
}
