//! The OpenAPI document of `/api/v1`, made of the table of routes and of the types of crate `api`.

use std::sync::LazyLock;

use api::NDJSON;
use api::problem::{PROBLEM_JSON, Problem};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde_json::json;
use utoipa::openapi::content::Content;
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::path::{HttpMethod, OperationBuilder, ParameterBuilder, ParameterIn, Paths};
use utoipa::openapi::request_body::RequestBodyBuilder;
use utoipa::openapi::schema::{
    Array, Components, KnownFormat, ObjectBuilder, Schema, SchemaFormat, Type,
};
use utoipa::openapi::security::{
    ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityRequirement, SecurityScheme,
};
use utoipa::openapi::{
    InfoBuilder, OpenApi, OpenApiBuilder, Ref, RefOr, Required, ResponseBuilder, Server,
};
use utoipa::{IntoParams, ToSchema};

use crate::errors::Error;
use crate::routes::{Access, ROUTES, Route};

/// What all addresses that are described begin with.
const BASE: &str = "/api/v1";
const JSON: &str = "application/json";
const EVENT_STREAM: &str = "text/event-stream";
const ABOUT: &str = "What cloudroidctl and the portal's page ask of cloudroidd. Robots connect elsewhere: \
                     ws://host:port/SERVICE?robot=ID speaks rosbridge v2. Images are served read-only at /v2/ (OCI \
                     distribution).";

type AnySchema = RefOr<Schema>;

/// One method at one address, in words and schemas.
pub struct Operation {
    built: OperationBuilder,
    /// Schemas that it refers to, by name.
    schemas: Vec<(String, AnySchema)>,
}

/// An operation: its id, by which generators of clients call it, and what it does.
pub fn operation(id: &str, summary: &str) -> Operation {
    let mut operation = Operation {
        built: OperationBuilder::new()
            .operation_id(Some(id))
            .summary(Some(summary)),
        schemas: Vec::new(),
    };
    let problem = operation.named::<Problem>();
    operation.answer("default", "Refused.", PROBLEM_JSON, problem)
}

impl Operation {
    /// It answers one value as JSON.
    pub fn answers<T: ToSchema>(mut self) -> Self {
        let schema = self.named::<T>();
        self.answer("200", "As asked.", JSON, schema)
    }

    /// It answers a list as JSON.
    pub fn lists<T: ToSchema>(mut self) -> Self {
        let schema = Array::new(self.named::<T>());
        self.answer("200", "As asked.", JSON, Schema::Array(schema).into())
    }

    /// It answers values as JSON lines.
    pub fn streams<T: ToSchema>(mut self) -> Self {
        let schema = self.named::<T>();
        self.answer("200", "As asked.", NDJSON, schema)
    }

    /// It answers server-sent events, whose data is a value as JSON.
    pub fn sends<T: ToSchema>(mut self) -> Self {
        let schema = self.named::<T>();
        self.answer("200", "As asked.", EVENT_STREAM, schema)
    }

    /// It answers a JSON object that is described elsewhere.
    pub fn answers_object(self) -> Self {
        let object = ObjectBuilder::new().schema_type(Type::Object);
        self.answer("200", "As asked.", JSON, object.into())
    }

    /// It answers a file of this media type.
    pub fn answers_file(self, media: &str) -> Self {
        let file = ObjectBuilder::new()
            .schema_type(Type::String)
            .format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary)));
        self.answer("200", "As asked.", media, file.into())
    }

    /// It sends a browser elsewhere.
    pub fn leads_on(mut self) -> Self {
        let response = ResponseBuilder::new().description("Elsewhere, by Location.");
        self.built = self.built.response("303", response);
        self
    }

    /// It becomes a WebSocket.
    pub fn becomes_a_websocket(mut self) -> Self {
        let response = ResponseBuilder::new().description("A WebSocket from here on.");
        self.built = self.built.response("101", response);
        self
    }

    /// It answers a page for people.
    pub fn answers_page(self) -> Self {
        let text = ObjectBuilder::new().schema_type(Type::String);
        self.answer("200", "As asked.", "text/html", text.into())
    }

    /// It reads these from the query.
    pub fn asks<P: IntoParams>(mut self) -> Self {
        for parameter in P::into_params(|| Some(ParameterIn::Query)) {
            self.built = self.built.parameter(parameter);
        }
        self
    }

    /// It reads a value as JSON from the query.
    pub fn asks_json<T: ToSchema>(mut self, name: &str, description: &str) -> Self {
        // `ParameterBuilder` knows no `content`.
        let content = Content::new(Some(self.named::<T>()));
        self.built = self.built.parameter(
            ParameterBuilder::new()
                .name(name)
                .parameter_in(ParameterIn::Query)
                .description(Some(description))
                .extensions(Some(Extensions::from_iter([(
                    "content",
                    json!({ JSON: content }),
                )]))),
        );
        self
    }

    /// Its body is a value as JSON.
    pub fn takes<T: ToSchema>(mut self, required: Required) -> Self {
        let schema = self.named::<T>();
        self.body(JSON, schema, RequestBodyBuilder::new(), required)
    }

    /// Its body is a file of this media type.
    pub fn takes_file(self, media: &str, description: &str, required: Required) -> Self {
        let file = ObjectBuilder::new()
            .schema_type(Type::String)
            .format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary)));
        let body = RequestBodyBuilder::new().description(Some(description));
        self.body(media, file.into(), body, required)
    }

    fn body(
        mut self,
        media: &str,
        schema: AnySchema,
        body: RequestBodyBuilder,
        required: Required,
    ) -> Self {
        let body = body
            .content(media, Content::new(Some(schema)))
            .required(Some(required));
        self.built = self.built.request_body(Some(body.build()));
        self
    }

    fn answer(mut self, status: &str, what: &str, media: &str, schema: AnySchema) -> Self {
        let response = ResponseBuilder::new()
            .description(what)
            .content(media, Content::new(Some(schema)));
        self.built = self.built.response(status, response);
        self
    }

    /// Refers to a type's schema, which the document then holds.
    fn named<T: ToSchema>(&mut self) -> AnySchema {
        T::schemas(&mut self.schemas);
        self.schemas.push((T::name().into_owned(), T::schema()));
        Ref::from_schema_name(T::name()).into()
    }
}

/// Describes those routes that have an operation.
fn document(routes: &[Route]) -> OpenApi {
    let mut paths = Paths::new();
    let mut components = Components::new();
    for route in routes {
        let (Some(operation), Some(path), Some(method)) = (
            route.operation,
            route.path.strip_prefix(BASE),
            method(route.method),
        ) else {
            continue;
        };
        let Operation { mut built, schemas } = operation();
        for parameter in named_in(path) {
            built = built.parameter(parameter);
        }
        if route.access == Access::Code {
            // Its body says who asks.
            built = built.security(SecurityRequirement::default());
        }
        paths.add_path_operation(path, vec![method], built);
        components.schemas.extend(schemas);
    }
    let token = Http::new(HttpAuthScheme::Bearer);
    components.add_security_scheme("bearer", SecurityScheme::Http(token));
    let token = ApiKey::Query(ApiKeyValue::new("token"));
    components.add_security_scheme("query", SecurityScheme::ApiKey(token));
    let none: [&str; 0] = [];
    OpenApiBuilder::new()
        .info(
            InfoBuilder::new()
                .title("Cloudroid")
                .version("1")
                .description(Some(ABOUT)),
        )
        .servers(Some([Server::new(BASE)]))
        .security(Some([
            SecurityRequirement::new("bearer", none),
            SecurityRequirement::new("query", none),
            SecurityRequirement::default(),
        ]))
        .paths(paths)
        .components(Some(components))
        .build()
}

fn method(name: &str) -> Option<HttpMethod> {
    Some(match name {
        "GET" => HttpMethod::Get,
        "POST" => HttpMethod::Post,
        "PATCH" => HttpMethod::Patch,
        "PUT" => HttpMethod::Put,
        "DELETE" => HttpMethod::Delete,
        _ => return None,
    })
}

/// What is named in a path: in `/services/{name}`, the service.
fn named_in(path: &str) -> impl Iterator<Item = ParameterBuilder> {
    let collections = path.split('/');
    collections
        .zip(path.split('/').skip(1))
        .filter_map(|(collection, segment)| {
            let name = segment.strip_prefix('{')?.strip_suffix('}')?;
            let text = ObjectBuilder::new().schema_type(Type::String);
            Some(
                ParameterBuilder::new()
                    .name(name)
                    .parameter_in(ParameterIn::Path)
                    .required(Required::True)
                    .description(Some(format!("The {}.", collection.trim_end_matches('s'))))
                    .schema(Some(text)),
            )
        })
}

/// The description of all this.
pub async fn serve() -> Result<Response, Error> {
    static DOCUMENT: LazyLock<Option<Bytes>> = LazyLock::new(|| {
        let text = document(ROUTES).to_json().ok()?;
        Some(Bytes::from(text))
    });
    let document = DOCUMENT
        .as_ref()
        .ok_or(Error::Internal("describing the portal"))?;
    Ok(([(header::CONTENT_TYPE, JSON)], document.clone()).into_response())
}

#[cfg(test)]
mod tests;
