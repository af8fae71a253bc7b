//! Reads files whose paths come from users, and replaces files as a whole.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Write};
use std::path::Path;

/// Opens a regular file for reading. Anything else is an error: opening a FIFO would wait for a writer, and a device may never end.
///
/// # Errors
///
/// If the file cannot be opened or is not a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    let mut options = File::options();
    options.read(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, rustix::fs::OFlags::NONBLOCK.bits().cast_signed());
    let file = options.open(path)?;
    if file.metadata()?.is_file() {
        Ok(file)
    } else {
        Err(io::Error::new(ErrorKind::InvalidInput, "it is not a regular file"))
    }
}

/// Reads a regular file, as many bytes as it has when it is opened.
///
/// # Errors
///
/// As for [`open`], or if the file cannot be read.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let file = open(path)?;
    let (length, mut content) = (file.metadata()?.len(), Vec::new());
    content.try_reserve_exact(usize::try_from(length).unwrap_or(usize::MAX))?;
    file.take(length).read_to_end(&mut content)?;
    Ok(content)
}

/// Writes a file under another name in the same folder, and renames it once it is on disk, so that a killed process or a full disk
/// leaves the former content.
///
/// # Errors
///
/// That of the first operation that failed; the file then has its former content.
pub fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut new = path.as_os_str().to_owned();
    new.push(".new");
    // What a killed process left. It may also be a link, whose target must not be written.
    let _ = fs::remove_file(&new);
    let write = || {
        let mut file = File::create_new(&new)?;
        file.write_all(content)?;
        file.sync_all()?;
        fs::rename(&new, path)
    };
    write().inspect_err(|_| drop(fs::remove_file(&new)))
}

#[cfg(all(test, unix))]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn only_regular_files_are_read() {
        let folder = std::env::temp_dir().join(format!("endless-files-{}", std::process::id()));
        std::fs::create_dir(&folder).unwrap();
        let [file, link, fifo] = ["file", "link", "fifo"].map(|name| folder.join(name));
        std::fs::write(&file, [7; 100_000]).unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        assert!(Command::new("mkfifo").arg(&fifo).status().unwrap().success());
        assert_eq!(read(&file).unwrap(), [7; 100_000]);
        assert_eq!(read(&link).unwrap().len(), 100_000);
        for other in [&fifo, &folder, Path::new("/dev/zero"), Path::new("/dev/null")] {
            assert_eq!(read(other).unwrap_err().to_string(), "it is not a regular file");
        }
        assert_eq!(read(&folder.join("missing")).unwrap_err().kind(), ErrorKind::NotFound);
        std::fs::remove_dir_all(folder).unwrap();
    }
}
