// The OpenAPI document, to read.

import { el } from "./dom.js";

const described = await (await fetch("openapi.json")).json();

const named = (id) => el("a", { href: `#${id}` }, id);
const code = (text) => el("code", {}, text);
const typed = ({ schema }, kind) => (schema.$ref ? named(schema.$ref.split("/").pop()) : code(kind));

function list(schemas) {
  return el("dl", {}, Object.entries(schemas).map(([name, schema]) => [el("dt", {}, code(name)), el("dd", {}, schema.description ?? "")]));
}

function operation(path, method, said) {
  const taken = Object.entries(said.requestBody?.content ?? {}).flatMap(([kind, content]) => [
    el("p", {}, "Takes ", code(kind), ": ", typed(content, "bytes"), "."),
    Object.values(content.examples ?? {}).map((example) => el("pre", {}, JSON.stringify(example.value))),
  ]);
  const answers = Object.entries(said.responses["200"].content).map(([kind, content]) => el("p", {}, "Answers ", typed(content, kind), "."));
  const asked = Object.fromEntries(said.parameters.map((each) => [each.name, each.schema]));
  return [el("h2", {}, code(`${method.toUpperCase()} ${path}`)), el("p", {}, said.summary), list(asked), taken, answers];
}

document.title = `${described.info.title} ${described.info.version}`;
document.getElementById("main").append(...[
  Object.entries(described.paths).map(([path, methods]) => Object.entries(methods).map(([method, said]) => operation(path, method, said))),
  el("h2", {}, "Objects"),
  Object.entries(described.components.schemas).map(([name, schema]) =>
    [el("h3", { id: name }, name), el("p", {}, schema.description), list(schema.properties ?? {})]),
].flat(9));
document.getElementById(location.hash.slice(1))?.scrollIntoView();
