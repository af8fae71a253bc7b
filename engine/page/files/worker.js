// The service worker: once loaded, the page works offline. The build inserts VERSION and FILES above this line.

const CACHE = `endless-gym-${VERSION}`;

/** The files that are kept once they were chosen: agents, and the engine of POPGym. */
const LATER = /\.safetensors$|\bpopgym\.wasm$/;

self.addEventListener("install", (event) => {
  const fill = async () => {
    const cache = await caches.open(CACHE);
    // Bypass the browser's HTTP cache, which may hold files of another version.
    await cache.addAll(["./", ...FILES.filter((file) => !LATER.test(file))].map((file) => new Request(file, { cache: "reload" })));
    await self.skipWaiting();
  };
  event.waitUntil(fill());
});

self.addEventListener("activate", (event) => {
  const tidy = async () => {
    const names = await caches.keys();
    const old = names.filter((name) => name.startsWith("endless-gym-") && name !== CACHE);
    await Promise.all(old.map((name) => caches.delete(name)));
    await self.clients.claim();
  };
  event.waitUntil(tidy());
});

self.addEventListener("fetch", (event) => {
  if (event.request.method !== "GET") return;
  const answer = async () => {
    const cache = await caches.open(CACHE);
    const known = await cache.match(event.request, { ignoreSearch: true });
    if (known) return known;
    const response = await fetch(event.request);
    if (response.ok && LATER.test(event.request.url)) await cache.put(event.request, response.clone());
    return response;
  };
  event.respondWith(answer());
});
