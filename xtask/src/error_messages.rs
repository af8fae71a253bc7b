//! The messages of the typed errors, read from the sources, for the documentation's page on troubleshooting.

use std::fs;
use std::path::Path;

use quote::ToTokens;
use serde_json::{Value, json};
use syn::punctuated::Punctuated;
use syn::{Attribute, Expr, ExprLit, Fields, Item, Lit, Meta, Token};

use crate::venv::workspace;

/// All types of `engine/` that derive `thiserror::Error`: `[{"type", "variants": [{"name", "doc", "message"}]}]`, sorted. A struct
/// has one variant without a name. Variants that show another error's message are left out.
pub fn as_json() -> Result<String, String> {
    let mut types = Vec::new();
    for name in ["core", "service", "view", "cli"] {
        collect(&workspace().join("engine").join(name).join("src"), &mut types)?;
    }
    types.sort_by_key(|described| described["type"].to_string());
    serde_json::to_string_pretty(&types).map_err(|error| error.to_string())
}

fn collect(folder: &Path, types: &mut Vec<Value>) -> Result<(), String> {
    let failed = |error: std::io::Error| format!("{}: {error}", folder.display());
    for entry in fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.is_dir() {
            collect(&path, types)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
            let file = syn::parse_file(&text).map_err(|error| format!("{}: {error}", path.display()))?;
            types.extend(file.items.iter().filter_map(described));
        }
    }
    Ok(())
}

/// The description of an item that derives `Error`.
fn described(item: &Item) -> Option<Value> {
    let (name, variants) = match item {
        Item::Enum(item) if derives_error(&item.attrs) => {
            let variants = item.variants.iter();
            (&item.ident, variants.filter_map(|v| variant(&v.ident.to_string(), &v.attrs, &v.fields)).collect())
        }
        Item::Struct(item) if derives_error(&item.attrs) => {
            (&item.ident, Vec::from_iter(variant("", &item.attrs, &item.fields)))
        }
        _ => return None,
    };
    Some(json!({"type": name.to_string(), "variants": variants}))
}

fn derives_error(attributes: &[Attribute]) -> bool {
    let derives = |attribute: &Attribute| {
        let text = attribute.meta.to_token_stream().to_string();
        text.starts_with("derive") && text.split(|c: char| !c.is_alphanumeric()).any(|word| word == "Error")
    };
    attributes.iter().any(derives)
}

/// The description of one variant, unless its `#[error]` is transparent.
fn variant(name: &str, attributes: &[Attribute], fields: &Fields) -> Option<Value> {
    let error = attributes.iter().find(|attribute| attribute.path().is_ident("error"))?;
    let arguments = error.parse_args_with(Punctuated::<Expr, Token![,]>::parse_terminated).ok()?;
    let mut arguments = arguments.iter();
    let Some(Expr::Lit(ExprLit { lit: Lit::Str(text), .. })) = arguments.next() else { return None };
    let fields: Vec<String> = fields.iter().filter_map(|field| field.ident.as_ref()).map(ToString::to_string).collect();
    let message = message(&text.value(), &fields, arguments);
    Some(json!({"name": name, "doc": documentation(attributes), "message": message}))
}

/// The text of a format string, with each field's name in angle brackets in place of its value.
fn message<'a>(format: &str, fields: &[String], mut arguments: impl Iterator<Item = &'a Expr>) -> String {
    let mut text = String::new();
    let mut rest = format;
    while let Some((before, after)) = rest.split_once('{') {
        let (placeholder, after) = after.split_once('}').unwrap_or((after, ""));
        let name = placeholder.split(':').next().unwrap_or_default();
        text.push_str(before);
        if name.is_empty() {
            let value = arguments.next().map(|value| value.to_token_stream().to_string()).unwrap_or_default();
            text.push_str(&shown(&value, fields));
        } else {
            text.push_str(&format!("<{name}>"));
        }
        rest = after;
    }
    text + rest
}

/// A placeholder for an argument of a format string.
fn shown(argument: &str, fields: &[String]) -> String {
    let word =
        argument.split(|c: char| !c.is_alphanumeric() && c != '_').find(|word| fields.contains(&(*word).to_owned()));
    match word {
        // The function of `ServiceError` that writes " (process 123)".
        Some(word) if argument.starts_with("in_process") => format!(" (process <{word}>)"),
        Some(word) if !argument.contains(" - ") && !argument.contains("saturating_") => format!("<{word}>"),
        _ => "<...>".to_owned(),
    }
}

/// The text of the documentation comments.
fn documentation(attributes: &[Attribute]) -> String {
    let line = |attribute: &Attribute| match &attribute.meta {
        Meta::NameValue(pair) if pair.path.is_ident("doc") => match &pair.value {
            Expr::Lit(ExprLit { lit: Lit::Str(text), .. }) => Some(text.value().trim().to_owned()),
            _ => None,
        },
        _ => None,
    };
    attributes.iter().filter_map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_name_their_fields() {
        let item: Item = syn::parse_quote! {
            #[derive(Debug, Error)]
            enum Fault {
                /// It is
                /// large.
                #[error("size must be at most {LIMIT}, got {given:?} in `{name}`{}, 0 to {}", in_process(*pid), given - 1)]
                Size { given: u32, name: String, pid: u32 },
                #[error(transparent)]
                Other(Inner),
            }
        };
        let message = "size must be at most <LIMIT>, got <given> in `<name>` (process <pid>), 0 to <...>";
        let variants = json!([{"name": "Size", "doc": "It is\nlarge.", "message": message}]);
        assert_eq!(described(&item), Some(json!({"type": "Fault", "variants": variants})));
        assert_eq!(described(&syn::parse_quote! { #[derive(Debug)] struct NoError; }), None);
    }
}
