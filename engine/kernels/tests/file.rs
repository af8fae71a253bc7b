//! Changes every part of a file of an agent.

use endless_gym_kernels::file::{FileError, read, write};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde_json::{Map, Value as Json, json};

const HEADER: &str = r#"{"version":2,"steps":64}"#;

fn whole(header: &str) -> Vec<u8> {
    let data: Vec<u8> = (0..24).collect();
    let view = |dtype, shape: &[usize], bytes| TensorView::new(dtype, shape.to_vec(), bytes).unwrap();
    let tensors = [("b", view(Dtype::F32, &[3, 2], &data)), ("a", view(Dtype::F32, &[2, 3], &data[..]))];
    let tensors = tensors.into_iter().chain([("state/c", view(Dtype::U8, &[4], &data[..4]))]);
    write(header.to_owned(), tensors.map(|(name, view)| (name.to_owned(), view)).collect()).unwrap()
}

/// A file with its description, the JSON text of the format, changed.
fn changed(file: &[u8], change: impl FnOnce(&mut Map<String, Json>)) -> Vec<u8> {
    let length = 8 + u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let mut description: Json = serde_json::from_slice(&file[8..length]).unwrap();
    change(description.as_object_mut().unwrap());
    let text = description.to_string();
    [&(text.len() as u64).to_le_bytes(), text.as_bytes(), &file[length..]].concat()
}

#[test]
fn a_file_is_read_back() {
    let file = whole(HEADER);
    let found = read(&file).unwrap();
    assert_eq!((found.header.as_deref(), found.tensors.len()), (Some(HEADER), 3));
    assert!(read(&changed(&file, |_| {})).is_ok());
}

#[test]
fn every_changed_part_is_refused() {
    let file = whole(HEADER);
    let refused = |what: &str, changed: &[u8]| assert!(read(changed).is_err(), "{what}");
    // Each byte of the data, and each prefix.
    let data = file.len() - (24 + 24 + 4);
    for at in data..file.len() {
        let mut damaged = file.clone();
        damaged[at] ^= 1;
        assert!(matches!(read(&damaged), Err(FileError::Checksum)), "{at}");
    }
    (0..file.len()).for_each(|length| refused("prefix", &file[..length]));
    for tensor in ["a", "b", "state/c"] {
        let field = |name: &str, value: Json| changed(&file, |all| all[tensor][name] = value);
        for dtype in ["F32", "I32", "U32", "F64", "I16", "BF16", "U8", "I8", "BOOL", "F8_E4M3"] {
            let dtype_changed = field("dtype", json!(dtype));
            assert_eq!(read(&dtype_changed).is_ok(), dtype_changed == changed(&file, |_| {}), "{tensor} {dtype}");
        }
        for shape in [json!([]), json!([6]), json!([1, 6]), json!([2, 2]), json!([4, 1]), json!([1, 4])] {
            refused(tensor, &field("shape", shape));
        }
        refused(tensor, &field("data_offsets", json!([0, 4])));
        refused(tensor, &changed(&file, |all| drop(all.remove(tensor))));
        let renamed = |all: &mut Map<String, Json>| {
            let description = all.remove(tensor).unwrap();
            all.insert("other".to_owned(), description);
        };
        refused(tensor, &changed(&file, renamed));
    }
    // Two tensors with each other's name, or shape.
    let swapped = |part: Option<&str>| {
        changed(&file, |all| {
            let (a, b) = (all["a"].clone(), all["b"].clone());
            match part {
                Some(part) => (all["a"][part], all["b"][part]) = (b[part].clone(), a[part].clone()),
                None => (all["a"], all["b"]) = (b, a),
            }
        })
    };
    refused("names", &swapped(None));
    refused("shapes", &swapped(Some("shape")));
    for entry in ["endless", "crc32"] {
        let metadata = |change: &dyn Fn(&mut Map<String, Json>)| {
            changed(&file, |all| change(all["__metadata__"].as_object_mut().unwrap()))
        };
        refused(entry, &metadata(&|all| drop(all.remove(entry))));
        refused(entry, &metadata(&|all| drop(all.insert(entry.to_owned(), json!("12345678")))));
        refused(
            entry,
            &metadata(&|all| {
                let value = all.remove(entry).unwrap();
                all.insert("other".to_owned(), value);
            }),
        );
    }
    for header in ["", "{}", "["] {
        refused(header, &whole(header));
    }
    for version in [0, 1, 3] {
        let other = whole(&format!(r#"{{"version":{version},"steps":64}}"#));
        assert!(matches!(read(&other), Err(FileError::Version { given }) if given == version));
    }
    for header in [r#"{"version":1,"steps":64}"#, r#"{"version":2,"steps":65}"#, r#"{"version":2,"stops":64}"#] {
        refused(header, &changed(&file, |all| all["__metadata__"]["endless"] = json!(header)));
    }
}

#[test]
fn weights_of_other_programs_are_read() {
    let file = whole(HEADER);
    let tensors = SafeTensors::deserialize(&file).unwrap().tensors();
    let weights = safetensors::serialize(tensors, None).unwrap();
    assert!(read(&weights).unwrap().header.is_none());
}
