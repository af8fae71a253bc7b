//! Reads files whose paths come from users, and replaces files as a whole.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

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
/// leaves the former content. The file keeps the mode of the one that it replaces. A link is replaced, and its target kept, so that
/// nothing outside of the folder is written.
///
/// # Errors
///
/// That of the first operation that failed; the file then has its former content, or the new one if only its folder cannot be
/// flushed.
pub fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let (new, mut file) = create_beside(path)?;
    let mut write = || {
        if let Some(former) = fs::symlink_metadata(path).ok().filter(fs::Metadata::is_file) {
            file.set_permissions(former.permissions())?;
        }
        file.write_all(content)?;
        file.sync_all()?;
        fs::rename(&new, path)
    };
    write().inspect_err(|_| drop(fs::remove_file(&new)))?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

/// Checks early that [`replace`] can write a file.
///
/// # Errors
///
/// If it is a folder, or no file can be created beside it.
pub fn check_replaceable(path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Err(ErrorKind::IsADirectory.into());
    }
    create_beside(path).and_then(|(new, _)| fs::remove_file(new))
}

/// Creates `FILE.new`, instead of one that a killed process left. It may also be a link, whose target must not be written.
fn create_beside(path: &Path) -> io::Result<(PathBuf, File)> {
    let mut new = path.as_os_str().to_owned();
    new.push(".new");
    match fs::remove_file(&new) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(e),
        _ => File::create_new(&new).map(|file| (new.into(), file)),
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};
    use std::process::Command;

    use super::*;

    /// A new folder.
    fn folder(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("endless-files-{name}-{}", std::process::id()));
        fs::create_dir(&folder).unwrap();
        folder
    }

    #[test]
    fn only_regular_files_are_read() {
        let folder = folder("read");
        let [file, link, fifo] = ["file", "link", "fifo"].map(|name| folder.join(name));
        fs::write(&file, [7; 100_000]).unwrap();
        symlink(&file, &link).unwrap();
        assert!(Command::new("mkfifo").arg(&fifo).status().unwrap().success());
        assert_eq!(read(&file).unwrap(), [7; 100_000]);
        assert_eq!(read(&link).unwrap().len(), 100_000);
        for other in [&fifo, &folder, Path::new("/dev/zero"), Path::new("/dev/null")] {
            assert_eq!(read(other).unwrap_err().to_string(), "it is not a regular file");
        }
        assert_eq!(read(&folder.join("missing")).unwrap_err().kind(), ErrorKind::NotFound);
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_replaced_file_keeps_its_mode_and_no_link_is_followed() {
        let folder = folder("replaced");
        let [file, new, other] = ["file", "file.new", "other"].map(|name| folder.join(name));
        let content = |path| fs::read_to_string(path).unwrap();
        fs::write(&other, "kept").unwrap();
        symlink(&other, &new).unwrap();
        symlink(&other, &file).unwrap();
        replace(&file, b"first").unwrap();
        assert!(fs::symlink_metadata(&file).unwrap().is_file() && content(&file) == "first");
        for mode in [0o600, 0o666, 0o400] {
            fs::set_permissions(&file, fs::Permissions::from_mode(mode)).unwrap();
            replace(&file, b"second").unwrap();
            assert_eq!((fs::metadata(&file).unwrap().permissions().mode() & 0o777, &*content(&file)), (mode, "second"));
        }
        // What this call did not create is not removed.
        fs::create_dir(&new).unwrap();
        replace(&file, b"third").unwrap_err();
        check_replaceable(&file).unwrap_err();
        assert!(new.is_dir() && content(&file) == "second" && content(&other) == "kept");
        fs::remove_dir(&new).unwrap();
        check_replaceable(&file).unwrap();
        check_replaceable(&folder).unwrap_err();
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 2);
        fs::remove_dir_all(folder).unwrap();
    }
}
