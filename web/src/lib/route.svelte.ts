// Which page is shown: what stands behind # in the address, such as #/servants/abc/log.

export const route = $state({ path: read() });

function read(): string[] {
  return location.hash
    .replace(/^#\/?/, '')
    .split('/')
    .filter(Boolean)
    .map((segment) => {
      try {
        return decodeURIComponent(segment);
      } catch {
        return segment;
      }
    });
}

addEventListener('hashchange', () => {
  route.path = read();
});

/** The address of a page. */
export const to = (...path: string[]) => `#/${path.map(encodeURIComponent).join('/')}`;
